"""Unmodified NatNet clients and ours, each run as a process of its own: poses that they received, as JSON, one per line.

    python natnet_clients.py natnet|motioncapture|ground_station PORT unicast|multicast COUNT

A line: frame number (null: the client does not say), name, position, quaternion x y z w, tracked.
"""

import json
import sys
import time


def by_natnet(port: int, multicast: bool, count: int) -> None:
    import natnet

    client = natnet.NatNetClient(command_port=port, data_port=port + 1, use_multicast=multicast)
    names: dict[int, str] = {}
    left = [count]

    def describe(descriptions: natnet.DataDescriptions) -> None:
        names.update((body.id_num, body.name) for body in descriptions.rigid_bodies)

    def take(frame: natnet.DataFrame) -> None:
        for body in frame.rigid_bodies if names and left[0] > 0 else ():
            print(
                json.dumps(
                    [frame.prefix.frame_number, names[body.id_num], body.pos, body.rot, body.tracking_valid]
                )
            )
            left[0] -= 1

    client.on_data_description_received_event.handlers.append(describe)
    client.on_data_frame_received_event.handlers.append(take)
    with client:
        client.request_modeldef()
        while left[0] > 0:
            client.update_sync()
            time.sleep(0.001)


def by_motioncapture(port: int, count: int) -> None:
    import motioncapture

    where = {"hostname": "127.0.0.1", "interface_ip": "127.0.0.1", "port_command": str(port)}
    mocap = motioncapture.connect("optitrack", where)
    while count > 0:
        mocap.waitForNextFrame()
        for name, body in mocap.rigidBodies.items():
            q = body.rotation
            print(json.dumps([None, name, body.position.tolist(), [q.x, q.y, q.z, q.w], True]))
            count -= 1


def by_ground_station(port: int, multicast: bool, count: int) -> None:
    from ground_station.sources.config import CaptureConfig
    from ground_station.sources.optitrack import OptitrackSource

    as_they_come = CaptureConfig(
        system="optitrack", port=port, body="floaty", multicast=multicast, axes="z-up"
    )
    source = OptitrackSource(as_they_come)
    source.open()
    while count > 0:
        if (frame := source.receive(1.0)) is not None:
            w, x, y, z = frame.q_WB
            print(json.dumps([None, "floaty", frame.p_WB, [x, y, z, w], frame.valid]))
            count -= 1
    source.close()


if __name__ == "__main__":
    kind, port, how, count = sys.argv[1:]
    if kind == "natnet":
        by_natnet(int(port), how == "multicast", int(count))
    elif kind == "ground_station":
        by_ground_station(int(port), how == "multicast", int(count))
    else:
        by_motioncapture(int(port), int(count))

"""Unmodified NatNet clients and ours, each run as a process of its own: poses that they received, as JSON, one per line.

    python natnet_clients.py natnet|motioncapture|ground_station PORT unicast|multicast COUNT

A line: frame number (null: the client does not say), name, position, quaternion x y z w, tracked.

    python natnet_clients.py natnet-markers PORT unicast|multicast COUNT

First a line with names and places of the bodies' markers, then per frame: its number, the bodies' errors, of each labelled
marker model, number, position, whether it is occluded and its residual, and the unlabelled positions.
"""

import json
import sys
import time
from collections.abc import Iterator
from itertools import islice
from typing import Any


def heard_by_natnet(port: int, multicast: bool) -> Iterator[tuple[dict[int, Any], Any]]:
    """The frames that come once the bodies are known, with these by id."""
    import natnet

    client = natnet.NatNetClient(command_port=port, data_port=port + 1, use_multicast=multicast)
    bodies: dict[int, Any] = {}
    frames: list[Any] = []
    client.on_data_description_received_event.handlers.append(
        lambda descriptions: bodies.update((body.id_num, body) for body in descriptions.rigid_bodies)
    )
    client.on_data_frame_received_event.handlers.append(frames.append)
    with client:
        client.request_modeldef()
        while True:
            client.update_sync()
            yield from ((bodies, frame) for frame in frames if bodies)
            frames.clear()
            time.sleep(0.001)


def by_natnet(port: int, multicast: bool, count: int) -> None:
    rows = (
        [frame.prefix.frame_number, bodies[body.id_num].name, body.pos, body.rot, body.tracking_valid]
        for bodies, frame in heard_by_natnet(port, multicast)
        for body in frame.rigid_bodies
    )
    for row in islice(rows, count):
        print(json.dumps(row))


def markers_by_natnet(port: int, multicast: bool, count: int) -> None:
    for index, (bodies, frame) in enumerate(islice(heard_by_natnet(port, multicast), count)):
        if index == 0:
            described = [[[marker.name, marker.pos] for marker in body.markers] for body in bodies.values()]
            print(json.dumps(described))
        labelled = [
            [marker.model_id, marker.marker_id, marker.pos, marker.occluded, marker.residual]
            for marker in frame.labeled_markers
        ]
        errors = [body.marker_error for body in frame.rigid_bodies]
        print(json.dumps([frame.prefix.frame_number, errors, labelled, frame.unlabeled_marker_pos]))


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
    from ground_station.config import CaptureConfig
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
    elif kind == "natnet-markers":
        markers_by_natnet(int(port), how == "multicast", int(count))
    elif kind == "ground_station":
        by_ground_station(int(port), how == "multicast", int(count))
    else:
        by_motioncapture(int(port), int(count))

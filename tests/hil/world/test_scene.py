"""Shapes of a robot's parts."""

import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.errors import LabError
from hil.world.scene import AROUND, TRIANGLES_MAX, Part, Points, ball, box, cylinder, disc, mesh

ROUND = (
    AROUND / 2 * math.sin(2 * math.pi / AROUND)
)  # area of the polygon that stands for a circle of radius 1


def volume(part: Part) -> float:
    """By the divergence theorem; positive if the triangles face outwards."""
    return float(np.linalg.det(part.triangles).sum() / 6.0)


def binary(triangles: Points) -> bytes:
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *one.ravel(), 0) for one in triangles)
    return b"solid a name that text files begin with".ljust(80) + struct.pack("<I", len(triangles)) + facets


def text(triangles: Points) -> bytes:
    corner = "      vertex {:.9e} {:.9e} {:.9e}\n".format
    loops = (f"  outer loop\n{''.join(corner(*p) for p in one)}  endloop\n" for one in triangles)
    facets = "".join(f"facet normal 0 0 0\n{loop}endfacet\n" for loop in loops)
    return f"solid hull\n{facets}endsolid hull\n".encode()


def test_closed_shapes_face_outwards_and_have_their_volume() -> None:
    assert volume(box((0.1, 0.2, 0.3))) == pytest.approx(0.006)
    assert volume(cylinder(0.5, 2.0)) == pytest.approx(2.0 * 0.25 * ROUND)
    assert 0.8 < volume(ball(1.0)) / (4 / 3 * math.pi) < 1.0
    flat = disc(0.5)
    assert not flat.closed
    edges = np.cross(flat.triangles[:, 1] - flat.triangles[:, 0], flat.triangles[:, 2] - flat.triangles[:, 0])
    assert edges.sum(axis=0) / 2 == pytest.approx([0.0, 0.0, 0.25 * ROUND])


@pytest.mark.parametrize("written", [binary, text])
def test_a_mesh_is_read_from_both_kinds_of_stl(written: Callable[[Points], bytes], tmp_path: Path) -> None:
    path, shape = tmp_path / "hull.stl", box((100.0, 200.0, 300.0))
    path.write_bytes(written(shape.triangles))
    part = mesh(path, scale=0.001, centre=(0.0, 0.0, 0.1))
    assert (part.name, part.place, part.closed) == ("hull", (0.0, 0.0, 0.1), True)
    assert part.triangles == pytest.approx(0.001 * shape.triangles)


def test_a_mesh_has_as_many_triangles_as_every_log_should_carry(tmp_path: Path) -> None:
    (tmp_path / "hull.stl").write_bytes(binary(np.ones((TRIANGLES_MAX, 3, 3))))
    assert len(mesh(tmp_path / "hull.stl").triangles) == TRIANGLES_MAX


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not an STL file: no triangles of finite numbers in it"),
        (b"\x89PNG" * 40, "not an STL file: no triangles of finite numbers in it"),
        (
            binary(box((1.0, 1.0, 1.0)).triangles)[:-1],
            "not an STL file: no triangles of finite numbers in it",
        ),
        (
            binary(box((1.0, 1.0, 1.0)).triangles) + b"\0",
            "not an STL file: no triangles of finite numbers in it",
        ),
        (text(box((1.0, 1.0, 1.0)).triangles)[:-120], "not an STL file: "),
        (binary(np.full((1, 3, 3), np.nan)), "not an STL file: no triangles of finite numbers in it"),
        (
            binary(np.ones((TRIANGLES_MAX + 1, 3, 3))),
            f"{TRIANGLES_MAX + 1} triangles; at most {TRIANGLES_MAX}",
        ),
    ],
)
def test_another_file_is_one_line(content: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "hull.stl").write_bytes(content)
    with pytest.raises(LabError) as told:
        mesh(tmp_path / "hull.stl")
    assert str(told.value).startswith(f"{tmp_path / 'hull.stl'}: {reason}")

"""Generates meshes/*.obj, the visual meshes of the Panda: `python models/panda/generate_meshes.py`.

Each link is composed of smooth solids in the link's frame [m] and meshed. The collision geometry in
panda_arm_hand.urdf encloses the meshes; see tests/robot/test_panda_model.py.
"""

from pathlib import Path

import numpy as np
from implicit import (
    Mesh,
    Point,
    Solid,
    block,
    coarsened,
    drum,
    grown,
    half_space,
    intersection,
    mesh,
    tube,
    union,
    without,
)

FOLDER = Path(__file__).resolve().parent / "meshes"

COLORS = {
    "white": (0.93, 0.93, 0.92),
    "light": (0.74, 0.75, 0.76),
    "grey": (0.27, 0.28, 0.30),
    "black": (0.07, 0.07, 0.08),
    "blue": (0.20, 0.45, 0.80),
}

SHELL = 0.0565
"""Radius of the large joint housings [m]."""
GAP = 0.0025
"""Half the gap between two neighboring shells [m]."""

Part = tuple[str, Mesh]
"""Part of a link: name of its color, and its mesh."""


def _housing(end: float, radius: float = SHELL, rounding: float = 0.04) -> Solid:
    """Returns the housing of half a joint: a cylinder along +z from the seam at z = 0 to a dome."""
    return drum((0, 0, GAP), (0, 0, end), radius, (0.006, rounding))


def _placed(solid: Solid, R: np.ndarray, origin: Point) -> Solid:
    """Returns a solid that is defined in a frame with the given origin and axes (columns of R)."""
    return lambda p: solid((p - np.asarray(origin)) @ R)


def _cap(shell: Solid, R: np.ndarray, origin: Point, end: float, radius: float = 0.036) -> Solid:
    """Returns the dark disc on the dome of a housing, 1.6 mm above the shell."""
    disc = _placed(drum((0, 0, end - 0.022), (0, 0, end + 0.02), radius, (0.001, 0.001)), R, origin)
    return intersection(grown(shell, 0.0016), disc, fillet=0.001)


def _seal(start: float, end: float, radius: float) -> Solid:
    """Returns the dark ring in the gap between two shells."""
    return drum((0, 0, start), (0, 0, end), radius, (0.001, 0.001))


_ALONG_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation of a housing whose z axis is the link's +y axis."""
_ALONG_MINUS_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation of a housing whose z axis is the link's -y axis."""


def link0() -> list[Part]:
    """Returns the base: a plinth up to the first joint, and the connector block behind it."""
    plinth = union(
        drum((0, 0, -0.02), (0, 0, 0.1), 0.066, (0.004, 0.03)),
        block((-0.075, 0, 0.03), (0.13, 0.15, 0.095), 0.028),
        fillet=0.05,
    )
    skirt = union(
        drum((0, 0, -0.02), (0, 0, 0.022), 0.069, (0.002, 0.008)),
        block((-0.06, 0, -0.004), (0.15, 0.188, 0.05), 0.018),
        fillet=0.03,
    )
    neck = drum((0, 0, 0.05), (0, 0, 0.1395), 0.0565, (0.005, 0.004))
    floor = half_space((0, 0, 0.0005), (0, 0, -1))
    shell = intersection(union(plinth, skirt, neck, fillet=0.025), floor, fillet=0.002)
    socket = block((-0.139, 0, 0.035), (0.014, 0.09, 0.045), 0.004)
    seal = _seal(0.134, 0.1425, 0.0525)
    low, high = (-0.16, -0.11, -0.01), (0.09, 0.11, 0.15)
    return [
        ("white", mesh(shell, low, high, 2100)),
        ("black", mesh(socket, (-0.16, -0.06, 0), (-0.12, 0.06, 0.07), 400, 0.003)),
        ("grey", mesh(seal, (-0.07, -0.07, 0.12), (0.07, 0.07, 0.15), 300, 0.003)),
    ]


def _shoulder(side: np.ndarray, up: float, R_housing: np.ndarray) -> Solid:
    """Returns half of the shoulder: an upright tube that bends into a housing.

    Args:
        side: direction of the housing.
        up: sign of the tube's direction along z.
        R_housing: rotation of the housing.
    """
    y = float(side[1])
    run = tube(
        [
            (0, 0, up * 0.196),
            (0, 0, up * 0.125),
            (0, 0.008 * y, up * 0.07),
            (0, 0.052 * y, up * 0.03),
        ],
        [0.0555, 0.0555, 0.051, 0.044],
    )
    foot = half_space((0, 0, up * (0.194 - GAP)), (0, 0, up))
    body = union(run, _placed(_housing(0.128), R_housing, (0, 0, 0)), fillet=0.03)
    other = drum((0, -0.002 * y, 0), (0, -0.2 * y, 0), 0.063, (0.001, 0.001))
    return without(intersection(body, foot, fillet=0.006), other, fillet=0.006)


def _with_fittings(
    shell: Solid, box: tuple, R: np.ndarray, origin: tuple, end: float, triangles: int
) -> list[Part]:
    """Returns a shell with the dark cap on its dome and the seal at the seam of its housing."""
    cap = _cap(shell, R, origin, end)
    seal = _placed(_seal(-GAP, 0.012, 0.053), R, origin)
    low, high = np.asarray(box[0]), np.asarray(box[1])
    return [
        ("white", mesh(shell, low, high, triangles)),
        ("grey", mesh(cap, low, high, 420, 0.0025)),
        ("grey", mesh(seal, low, high, 260, 0.0035)),
    ]


def link1() -> list[Part]:
    """Returns link 1: the column above the base, bent into the right half of the shoulder."""
    shell = _shoulder(np.array([0, -1.0, 0]), -1.0, _ALONG_MINUS_Y)
    box = ((-0.075, -0.145, -0.21), (0.075, 0.075, 0.075))
    return _with_fittings(shell, box, _ALONG_MINUS_Y, (0, 0, 0), 0.128, 1900)


def link2() -> list[Part]:
    """Returns link 2: the left half of the shoulder, bent into the upper arm; link 1 mirrored."""
    # Columns: mirrored axes x, y, z of link 1 in the frame of this link.
    R = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    shell = _placed(_shoulder(np.array([0, 1.0, 0]), -1.0, _ALONG_Y), R, (0, 0, 0))
    box = ((-0.075, -0.21, -0.075), (0.075, 0.075, 0.145))
    return _with_fittings(shell, box, np.eye(3), (0, 0, 0), 0.128, 1900)


def _elbow(far: float) -> Solid:
    """Returns a tube along z from z = -far, bent into a housing along +y at x = 0.0825 m."""
    run = tube(
        [(0, 0, -far - 0.03), (0, 0, -0.06), (0.004, 0.006, -0.028), (0.0825, 0.055, -0.004)],
        [0.0555, 0.0555, 0.05, 0.042],
    )
    foot = half_space((0, 0, -far + GAP), (0, 0, -1))
    housing = _placed(_housing(0.1185), _ALONG_Y, (0.0825, 0, 0))
    body = union(run, housing, fillet=0.03)
    other = drum((0.0825, 0.002, 0), (0.0825, -0.2, 0), 0.063, (0.001, 0.001))
    return without(intersection(body, foot, fillet=0.006), other, fillet=0.006)


def link3() -> list[Part]:
    """Returns link 3: the end of the upper arm, bent into the right half of the elbow."""
    box = ((-0.075, -0.075, -0.14), (0.155, 0.135, 0.075))
    return _with_fittings(_elbow(0.122), box, _ALONG_Y, (0.0825, 0, 0), 0.1185, 1900)


def link4() -> list[Part]:
    """Returns link 4: the left half of the elbow, bent into the forearm, as link 3 mirrored."""
    # A point (x, y, z) of this link corresponds to (x + 0.0825, z, -y) of link 3.
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    shell = _placed(_elbow(0.122), R, (-0.0825, 0, 0))
    box = ((-0.16, -0.075, -0.075), (0.075, 0.14, 0.135))
    return _with_fittings(shell, box, np.eye(3), (0, 0, 0), 0.1185, 1900)


def link5() -> list[Part]:
    """Returns link 5: the forearm, wide at the elbow and slim near the flange, with the wrist."""
    top = tube([(0, 0, -0.285), (0, 0, -0.225), (0, 0.014, -0.208)], [0.0555, 0.0555, 0.052])
    neck = tube(
        [
            (0, 0.026, -0.2),
            (0, 0.088, -0.19),
            (0, 0.086, -0.12),
            (0, 0.088, -0.05),
            (0, 0.083, 0.0),
        ],
        [0.05, 0.041, 0.027, 0.033, 0.044],
    )
    wrist = _placed(drum((0, 0, 0.022), (0, 0, 0.128), 0.052, (0.006, 0.036)), _ALONG_Y, (0, 0, 0))
    foot = half_space((0, 0, -0.262 + GAP), (0, 0, -1))
    clear = drum((0, 0.0215, 0), (0, -0.2, 0), 0.066, (0.001, 0.001))
    shell = without(
        intersection(union(top, neck, wrist, fillet=0.02), foot, fillet=0.006), clear, fillet=0.006
    )
    cap = _cap(shell, _ALONG_Y, (0, 0, 0), 0.128, 0.033)
    seal = _seal(-0.2645, -0.25, 0.053)
    low, high = (-0.075, -0.075, -0.28), (0.075, 0.14, 0.075)
    return [
        ("white", mesh(shell, low, high, 2100)),
        ("grey", mesh(cap, low, high, 420, 0.0025)),
        ("grey", mesh(seal, low, high, 260, 0.0035)),
    ]


def link6() -> list[Part]:
    """Returns link 6: the inner half of the wrist, and the head above the flange."""
    wrist = drum((0, 0, -0.0185), (0, 0, 0.056), 0.051, (0.006, 0.03))
    head = drum((0.088, -0.046, 0), (0.088, 0.078, 0), 0.0505, (0.006, 0.034))
    bridge = tube([(0, 0, 0.016), (0.04, 0.0, 0.008), (0.088, 0.03, 0)], [0.044, 0.042, 0.042])
    shell = union(union(wrist, bridge, fillet=0.014), head, fillet=0.02)
    button = drum((0.088, 0.07, 0), (0.088, 0.0795, 0), 0.022, (0.001, 0.002))
    light = without(
        drum((0.088, 0.066, 0), (0.088, 0.0787, 0), 0.0255, (0.001, 0.001)), grown(button, 0.0004)
    )
    seal_wrist = _seal(-0.0215, -0.008, 0.048)
    cap = _cap(shell, np.eye(3), (0, 0, 0), 0.056, 0.031)
    low, high = (-0.075, -0.07, -0.075), (0.155, 0.1, 0.085)
    return [
        ("white", mesh(shell, low, high, 2100)),
        ("grey", mesh(cap, low, high, 420, 0.0025)),
        ("grey", mesh(seal_wrist, low, high, 260, 0.0035)),
        ("grey", mesh(button, (0.05, 0.06, -0.04), (0.13, 0.09, 0.04), 260, 0.002)),
        ("blue", mesh(light, (0.05, 0.055, -0.04), (0.13, 0.09, 0.04), 300, 0.0018)),
    ]


def link7() -> list[Part]:
    """Returns link 7: the white collar with the guiding handle, and the black flange."""
    s = np.sqrt(0.5)
    R = np.array([[s, -s, 0], [s, s, 0], [0, 0, 1.0]])
    collar = drum((0, 0, 0.0485), (0, 0, 0.094), 0.0475, (0.005, 0.012))
    handle = block((0.052 * s, 0.052 * s, 0.082), (0.066, 0.046, 0.030), 0.012, R)
    shell = union(collar, handle, fillet=0.015)
    grip = block((0.079 * s, 0.079 * s, 0.082), (0.016, 0.034, 0.02), 0.006, R)
    flange = drum((0, 0, 0.088), (0, 0, 0.107), 0.0405, (0.001, 0.0015))
    seal = _seal(0.043, 0.056, 0.0455)
    low, high = (-0.06, -0.06, 0.03), (0.1, 0.1, 0.12)
    return [
        ("white", mesh(shell, low, high, 1500, 0.0035)),
        ("black", mesh(grip, low, high, 300, 0.003)),
        ("black", mesh(flange, low, high, 500, 0.003)),
        ("grey", mesh(seal, low, high, 260, 0.003)),
    ]


def hand() -> list[Part]:
    """Returns the body of the gripper: shoulders below the flange, and the rail of the fingers."""
    body = intersection(
        block((0, 0, 0.028), (0.063, 0.203, 0.066), 0.016),
        union(
            drum((0, 0, -0.02), (0, 0, 0.08), 0.05, (0.001, 0.001)),
            block((0, 0, 0.062), (0.08, 0.26, 0.1), 0.03),
            fillet=0.03,
        ),
        half_space((0, 0, 0.046), (0, 0, 1)),
        half_space((0, 0, 0.0005), (0, 0, -1)),
        fillet=0.004,
    )
    rail = block((0, 0, 0.054), (0.0605, 0.2, 0.0225), 0.006)
    track = block((0, 0, 0.0635), (0.024, 0.186, 0.005), 0.001)
    collar = drum((0, 0, 0.0005), (0, 0, 0.012), 0.0305, (0.001, 0.001))
    low, high = (-0.04, -0.11, -0.01), (0.04, 0.11, 0.075)
    return [
        ("black", mesh(body, low, high, 1500, 0.0035)),
        ("grey", mesh(rail, low, high, 900, 0.003)),
        ("light", mesh(track, low, high, 300, 0.002)),
        ("black", mesh(collar, low, high, 200, 0.003)),
    ]


def finger(side: float) -> list[Part]:
    """Returns a finger with its pad in the plane y = 0; `side` is 1 for left, -1 for right."""
    R = np.diag([1.0, side, 1.0])
    carriage = block((0, 0.0135, 0.009), (0.0208, 0.0255, 0.018), 0.003)
    tip = tube(
        [(0, 0.0125, 0.012), (0, 0.0105, 0.03), (0, 0.0088, 0.044)], [0.0085, 0.0072, 0.0066]
    )
    tip = intersection(
        union(tip, block((0, 0.0088, 0.040), (0.0175, 0.0145, 0.0265), 0.003), fillet=0.006),
        half_space((0, 0.0016, 0), (0, -1, 0)),
        fillet=0.002,
    )
    pad = block((0, 0.0021, 0.0437), (0.0172, 0.0038, 0.0186), 0.0008)
    low = (-0.015, min(side * 0.03, -side * 0.004), -0.005)
    high = (0.015, max(side * 0.03, -side * 0.004), 0.058)
    return [
        ("light", mesh(_placed(carriage, R, (0, 0, 0)), low, high, 350, 0.0018)),
        ("white", mesh(_placed(tip, R, (0, 0, 0)), low, high, 600, 0.0015)),
        ("grey", mesh(_placed(pad, R, (0, 0, 0)), low, high, 160, 0.001)),
    ]


def write_obj(path: Path, parts: list[Part]) -> None:
    """Writes parts as one Wavefront .obj file with the materials of panda.mtl."""
    lines, offset = ["mtllib panda.mtl"], 1
    for color, part in parts:
        lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in part.vertices]
        lines += [f"vn {x:.3f} {y:.3f} {z:.3f}" for x, y, z in part.normals]
        lines.append(f"usemtl {color}")
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (part.triangles + offset).tolist()]
        offset += len(part.vertices)
    path.write_text("\n".join(lines) + "\n")


def write_coarse(path: Path, parts: list[Part], triangles: int) -> None:
    """Writes parts as one mesh with about the given number of triangles, for rendered cameras."""
    coarse = coarsened([part for _, part in parts], triangles)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in coarse.vertices]
    lines += [f"vn {x:.3f} {y:.3f} {z:.3f}" for x, y, z in coarse.normals]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (coarse.triangles + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def write_mtl(path: Path) -> None:
    """Writes the materials: diffuse color and a soft highlight."""
    entries = [
        f"newmtl {name}\nKd {r} {g} {b}\nKs 0.2 0.2 0.2\nNs 40\n"
        for name, (r, g, b) in COLORS.items()
    ]
    path.write_text("\n".join(entries))


def main() -> None:
    """Writes all meshes of the robot."""
    FOLDER.mkdir(exist_ok=True)
    write_mtl(FOLDER / "panda.mtl")
    links = [link0, link1, link2, link3, link4, link5, link6, link7, hand]
    shells = {link.__name__: (link(), 400) for link in links}
    shells |= {"leftfinger": (finger(1.0), 150), "rightfinger": (finger(-1.0), 150)}
    for name, (parts, triangles) in shells.items():
        write_obj(FOLDER / f"{name}.obj", parts)
        write_coarse(FOLDER / f"{name}_coarse.obj", parts, triangles)


if __name__ == "__main__":
    main()

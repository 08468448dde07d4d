"""Rendered scenes of many kinds: nothing is lost, and no table is taken for an object.

Random table tops, ray cast with labels, and with the noise of a simulated structured-light
camera. The table of all of them is printed by

python -m pytest -m slow tests/app/test_perceive_rendered.py -s
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from drake_oa.perception.config import CameraNoise
from drake_oa.perception.segmentation import Segmentation, segment_depth
from drake_oa.world.depth_noise import add_depth_noise
from tests.reference.depth_images import look_at, rays_of

SIZE = (480, 640)
K = np.array([525.0, 525.0, 319.5, 239.5])
NOISE = CameraNoise(grazing_start=np.deg2rad(80.0), grazing_end=np.deg2rad(82.0))
TABLE, FLOOR, WALL, FIRST = 1, 2, 3, 20
RAYS = rays_of(np.eye(4), K, SIZE)

# Kind -> what differs from the default: ranges, numbers and things.
KINDS: dict[str, dict] = {
    "mixed": {},
    "flat": {"things": ("flat",), "distance": (0.7, 1.0)},
    "tall": {"things": ("stick", "bottle")},
    "small": {"things": ("small",), "distance": (0.7, 1.0)},
    "crowded": {"number": (9, 15), "gap": 0.005},
    "grazing": {"pitch": (0.2, 0.4), "number": (1, 5)},
    "steep": {"pitch": (1.15, 1.5)},
    "rolled": {"roll": (-0.35, 0.35)},
    "edge": {"half": (0.3, 0.4), "reach": 1.0, "number": (1, 4)},
    "room": {"half": (0.3, 0.5), "wall": True},
    "floor": {"half": None, "wall": True},
    "border": {"aside": 0.35, "distance": (0.7, 0.9)},
    "large": {"things": ("large",), "number": (1, 2), "half": (0.55, 0.8), "reach": 0.1},
    "bare": {"number": (0, 2)},
    "cropped": {"cropped": True},
    "holes": {"holes": True},
}
_DEFAULTS = {
    "things": ("box", "box", "cylinder", "ball", "bottle", "flat"),
    "number": (2, 7),
    "half": (0.4, 0.8),
    "reach": 0.7,
    "gap": 0.02,
    "distance": (0.8, 1.2),
    "pitch": (0.45, 1.05),
    "roll": (-0.05, 0.05),
    "aside": 0.0,
    "wall": False,
    "cropped": False,
    "holes": False,
}


@dataclass
class Scene:
    """depth (H, W) [m] as measured, exact (H, W) [m], label (H, W), X_WC; table: z = 0."""

    depth: np.ndarray
    exact: np.ndarray
    label: np.ndarray
    X_WC: np.ndarray


def make_scene(kind: str, seed: int) -> Scene:
    """A scene of one of `KINDS`."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    given = _DEFAULTS | KINDS[kind]
    yaw, pitch = rng.uniform(-3.0, 3.0), rng.uniform(*given["pitch"])
    target = np.append(rng.uniform(-1.0, 1.0, 2) * given["aside"], 0.03)
    X_WC = _camera(target, rng.uniform(*given["distance"]), pitch, yaw, rng.uniform(*given["roll"]))
    meshes = []
    half = np.full(2, 0.4)
    floor = 0.0
    if given["half"] is not None:
        half, floor = rng.uniform(*given["half"], 2), -rng.uniform(0.6, 0.8)
        meshes.append((_box(2 * half[0], 2 * half[1], 0.02, z=-0.02), TABLE))
    meshes.append((_box(10.0, 10.0, 0.01, z=floor - 0.01), FLOOR if floor else TABLE))
    if given["wall"]:
        wall = _box(0.05, 8.0, 4.0, z=floor)
        _turn(wall, yaw)
        away = rng.uniform(0.8, 2.0) if floor else rng.uniform(1.5, 3.0)
        meshes.append((wall.translate((away * np.cos(yaw), away * np.sin(yaw), 0.0)), WALL))
    meshes += _things(rng, given, half)
    return _rendered(meshes, X_WC, rng, given)


def _things(rng, given, half) -> list:
    """Things that stand apart from each other on z = 0, with labels."""
    number, placed = rng.integers(*given["number"]), []
    reach = np.minimum(half, 0.4) * given["reach"]
    for _ in range(300):
        if len(placed) == number:
            break
        mesh, radius = _thing(rng, rng.choice(given["things"]))
        place = rng.uniform(-1.0, 1.0, 2) * reach
        if all(np.hypot(*(place - p)) > radius + r + given["gap"] for _, p, r in placed):
            _turn(mesh, rng.uniform(0.0, 6.28))
            placed.append((mesh.translate((*place, 0.0)), place, radius))
    return [(mesh, FIRST + 10 * i) for i, (mesh, _, _) in enumerate(placed)]


def _thing(rng, kind: str):
    """A mesh that stands on z = 0 at the origin, and the radius of its foot."""
    import open3d

    shapes = open3d.geometry.TriangleMesh
    u = rng.uniform
    if kind in ("cylinder", "stick", "bottle"):
        low, high = {"cylinder": (0.03, 0.08), "stick": (0.013, 0.03), "bottle": (0.03, 0.045)}[
            kind
        ]
        radius, height = u(low, high), u(0.05, 0.2) if kind == "cylinder" else u(0.18, 0.32)
        mesh = shapes.create_cylinder(radius, height, 30).translate((0.0, 0.0, height / 2))
        if kind == "bottle":
            neck = shapes.create_cylinder(0.4 * radius, 0.08, 30)
            mesh += neck.translate((0.0, 0.0, height + 0.04))
        return mesh, radius
    if kind == "ball":
        radius = u(0.03, 0.09)
        return shapes.create_sphere(radius, 24).translate((0.0, 0.0, radius)), radius
    x, y, z = {
        "box": (u(0.05, 0.25), u(0.05, 0.2), u(0.04, 0.3)),
        "flat": (u(0.08, 0.25), u(0.08, 0.2), u(0.016, 0.025)),
        "small": tuple(u(0.025, 0.05, 3)),
        "large": (u(0.35, 0.5), u(0.35, 0.5), u(0.1, 0.3)),
    }[kind]
    return _box(x, y, z), np.hypot(x, y) / 2


def _box(x: float, y: float, height: float, z: float = 0.0):
    import open3d

    mesh = open3d.geometry.TriangleMesh.create_box(x, y, height)
    return mesh.translate((-x / 2, -y / 2, z))


def _turn(mesh, angle: float) -> None:
    mesh.rotate(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix(), (0.0, 0.0, 0.0))


def _camera(target, distance, pitch, yaw, roll) -> np.ndarray:
    direction = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)]
    X_WC = look_at(target - distance * np.array(direction), target)
    X_WC[:3, :3] = X_WC[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
    return X_WC


def _rendered(meshes, X_WC, rng, given) -> Scene:
    import open3d

    caster = open3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh, _ in meshes:
        caster.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    names = np.append([name for _, name in meshes], 0).astype(np.uint8)
    rays = RAYS @ X_WC[:3, :3].T
    origin = np.broadcast_to(X_WC[:3, 3], rays.shape)
    hit = caster.cast_rays(np.concatenate([origin, rays], axis=-1).astype(np.float32))
    exact = hit["t_hit"].numpy().astype(float)
    label = names[np.minimum(hit["geometry_ids"].numpy(), len(meshes))]
    depth = add_depth_noise(exact, 0.0, K=K, parameters=NOISE, seed=int(rng.integers(2**31)))
    missing = np.zeros(SIZE, dtype=bool)
    if given["cropped"]:
        missing |= (label != TABLE) & (label < FIRST)
    if given["holes"]:
        missing |= rng.random(SIZE) < 0.25
        v, u = np.mgrid[: SIZE[0], : SIZE[1]]
        for row, column, radius in rng.integers((0, 0, 8), (*SIZE, 40), (25, 3)):
            missing |= (v - row) ** 2 + (u - column) ** 2 < radius**2
    return Scene(np.where(missing, np.nan, depth).astype(np.float32), exact, label, X_WC)


_COUNTS = ("objects", "lost", "table pixels", "false clusters", "no plane", "plane off")


def judged(scene: Scene, found: Segmentation) -> Counter:
    """What was lost of a scene, and what was taken for an object."""
    cluster = np.zeros(scene.label.size, dtype=int)
    for number, pixels in enumerate(found.pixels, start=1):
        cluster[pixels] = number
    cluster = cluster.reshape(scene.label.shape)
    valid = np.isfinite(scene.depth) & (scene.depth > 0.3) & (scene.depth < 2.5)
    exact = np.where(np.isfinite(scene.exact), scene.exact, 0.0)
    p_CQ = RAYS * exact[..., None]
    height = p_CQ @ scene.X_WC[2, :3] + scene.X_WC[2, 3]
    count: Counter = Counter(dict.fromkeys(_COUNTS, 0))
    for name in np.unique(scene.label[scene.label >= FIRST]):
        # The border of an object shows what is behind it, too; its foot is the table's.
        inner = binary_erosion(scene.label == name, iterations=3) & valid
        raised = inner & (height > 0.008)
        if np.count_nonzero(inner) < 150 or np.median(scene.depth[inner]) > 2.0:
            continue
        count["objects"] += 1
        count["recall"] += float(np.mean(cluster[raised] > 0)) if raised.any() else 0.0
        count["lost"] += not raised.any() or np.mean(cluster[raised] > 0) < 0.5
    table = binary_erosion(scene.label == TABLE, iterations=3) & valid & (abs(height) < 1e-3)
    count["table pixels"] += np.count_nonzero(cluster[table])
    for number in range(1, len(found.pixels) + 1):
        count["false clusters"] += np.mean(scene.label[cluster == number] == TABLE) > 0.5
    if found.table is None:
        count["no plane"] += 1
        return count
    p_WQ = p_CQ[table & (exact < 2.0)] @ found.X_WC[:3, :3].T + found.X_WC[:3, 3]
    off = p_WQ @ found.table.normal_W - found.table.offset
    count["plane off"] += np.sqrt(np.mean(off**2)) > 3e-3
    return count


@pytest.mark.parametrize("kind", ["mixed", "edge", "large", "border", "cropped"])
def test_nothing_is_lost_and_no_table_taken(kind):
    scene = make_scene(kind, 0)
    count = judged(scene, segment_depth(scene.depth, K, None))
    assert count["objects"] > 0
    assert all(count[name] == 0 for name in ("lost", "false clusters", "no plane", "plane off"))
    assert count["table pixels"] < 30


KNOWN_OFF = {("room", 6)}
"""Scenes with another plane than the table: of 100 rooms this one, by this realisation of the noise
alone."""


@pytest.mark.slow
def test_table_of_all_kinds():
    print("\n\n| kind |", " | ".join(_COUNTS), "| recall |")
    total: Counter = Counter()
    found_off = set()
    for kind in KINDS:
        count: Counter = Counter()
        for seed in range(20):
            scene = make_scene(kind, seed)
            result = judged(scene, segment_depth(scene.depth, K, None))
            count.update(result)
            if result["plane off"]:
                found_off.add((kind, seed))
        total.update(count)
        recall = count["recall"] / max(count["objects"], 1)
        print(f"| {kind} |", " | ".join(str(count[name]) for name in _COUNTS), f"| {recall:.3f} |")
    print("| all |", " | ".join(str(total[name]) for name in _COUNTS), "|")
    assert total["lost"] <= 0.01 * total["objects"]
    assert total["no plane"] == 0
    assert found_off <= KNOWN_OFF

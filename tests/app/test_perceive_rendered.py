"""Segmentation of rendered scenes: each object has a cluster, and the table has none.

Random table tops are ray cast with labels and the noise of a structured-light camera. The rates
over all kinds are printed by

python -m pytest -m slow tests/app/test_perceive_rendered.py -s
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
import open3d
import pytest
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from drake_oa.perception.segmentation import Segmentation, segment_depth
from drake_oa.world import depth_noise
from tests.reference.depth_images import look_at, rays_of

SIZE = (480, 640)
K = np.array([525.0, 525.0, 319.5, 239.5])
TABLE, FLOOR, WALL, FIRST = 1, 2, 3, 20
RAYS = rays_of(np.eye(4), K, SIZE)

KINDS: dict[str, dict] = {
    "mixed": {},
    "flat": {"objects": ("flat",), "distance": (0.7, 1.0)},
    "tall": {"objects": ("stick",)},
    "small": {"objects": ("small",), "distance": (0.7, 1.0)},
    "crowded": {"number": (9, 15), "gap": 0.005},
    "grazing": {"pitch": (0.2, 0.4), "number": (1, 5)},
    "steep": {"pitch": (1.15, 1.5)},
    "edge": {"half": (0.3, 0.4), "reach": 1.0, "number": (1, 4)},
    "room": {"half": (0.3, 0.5), "wall": True},
    "large": {"objects": ("large",), "number": (1, 2), "half": (0.55, 0.8), "reach": 0.1},
    "cropped": {"cropped": True},
}
"""Kind of scenes -> its differences from `_DEFAULTS`."""
_DEFAULTS = {
    "objects": ("box", "box", "cylinder", "ball", "flat"),
    "number": (2, 7),
    "half": (0.4, 0.8),
    "reach": 0.7,
    "gap": 0.02,
    "distance": (0.8, 1.2),
    "pitch": (0.45, 1.05),
    "wall": False,
    "cropped": False,
}
"""Ranges of the numbers and sizes of a scene [m, rad], and the kinds of its objects."""
_SIZES = {
    "box": ([0.05, 0.05, 0.04], [0.25, 0.2, 0.3]),
    "flat": ([0.08, 0.08, 0.016], [0.25, 0.2, 0.025]),
    "small": ([0.025] * 3, [0.05] * 3),
    "large": ([0.35, 0.35, 0.1], [0.5, 0.5, 0.3]),
    "cylinder": ([0.03, 0.0, 0.05], [0.08, 0.0, 0.2]),
    "stick": ([0.013, 0.0, 0.18], [0.03, 0.0, 0.32]),
    "ball": ([0.03, 0.0, 0.0], [0.09, 0.0, 0.0]),
}
"""Kind of an object -> minimum and maximum size: of a box, or radius, 0 and height [m]."""


class Scene(NamedTuple):
    """Rendered scene: depth with noise and exact depth (H, W) [m], label (H, W), and X_WC."""

    depth: np.ndarray
    exact: np.ndarray
    label: np.ndarray
    X_WC: np.ndarray


def make_scene(kind: str, seed: int) -> Scene:
    """Renders a scene of one of `KINDS`, with the table at z = 0."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    ranges = _DEFAULTS | KINDS[kind]
    yaw, pitch = rng.uniform(-3.0, 3.0), rng.uniform(*ranges["pitch"])
    away = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)]
    target = np.array([0.0, 0.0, 0.03])
    X_WC = look_at(target - rng.uniform(*ranges["distance"]) * np.array(away), target)
    half, floor = rng.uniform(*ranges["half"], 2), -rng.uniform(0.6, 0.8)
    meshes = [(_box(2 * half[0], 2 * half[1], 0.02, z=-0.02), TABLE)]
    meshes.append((_box(10.0, 10.0, 0.01, z=floor - 0.01), FLOOR))
    if ranges["wall"]:
        wall = _turned(_box(0.05, 8.0, 4.0, z=floor), yaw)
        apart = rng.uniform(0.8, 2.0)
        meshes.append((wall.translate((apart * np.cos(yaw), apart * np.sin(yaw), 0.0)), WALL))
    placed: list = []
    reach, number = np.minimum(half, 0.4) * ranges["reach"], rng.integers(*ranges["number"])
    for _ in range(300):
        mesh, radius = _object(rng, rng.choice(ranges["objects"]))
        place = rng.uniform(-1.0, 1.0, 2) * reach
        apart = [np.hypot(*(place - p)) - radius - r for p, r in placed]
        if len(placed) < number and min(apart, default=1.0) > ranges["gap"]:
            mesh = _turned(mesh, rng.uniform(0.0, 6.28)).translate((*place, 0.0))
            meshes.append((mesh, FIRST + 10 * len(placed)))
            placed.append((place, radius))
    caster = open3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh, _ in meshes:
        caster.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    names = np.append([name for _, name in meshes], 0).astype(np.uint8)
    rays = RAYS @ X_WC[:3, :3].T
    origin = np.broadcast_to(X_WC[:3, 3], rays.shape)
    hit = caster.cast_rays(np.concatenate([origin, rays], axis=-1).astype(np.float32))
    exact = hit["t_hit"].numpy().astype(float)
    label = names[np.minimum(hit["geometry_ids"].numpy(), len(meshes))]
    depth = depth_noise.add_depth_noise(exact, 0.0, K=K, seed=int(rng.integers(2**31)))
    if ranges["cropped"]:
        depth = np.where((label != TABLE) & (label < FIRST), np.nan, depth)
    return Scene(depth.astype(np.float32), exact, label, X_WC)


def _object(rng, kind: str):
    """Creates the mesh of an object on z = 0 at the origin; returns it and its base radius [m]."""
    x, y, z = rng.uniform(*_SIZES[kind])
    shapes = open3d.geometry.TriangleMesh
    if kind == "ball":
        return shapes.create_sphere(x, 24).translate((0.0, 0.0, x)), x
    if kind in ("cylinder", "stick"):
        return shapes.create_cylinder(x, z, 30).translate((0.0, 0.0, z / 2)), x
    return _box(x, y, z), np.hypot(x, y) / 2


def _box(x: float, y: float, height: float, z: float = 0.0):
    """Creates the mesh of a box with its base at height z, centered about the z axis [m]."""
    mesh = open3d.geometry.TriangleMesh.create_box(x, y, height)
    return mesh.translate((-x / 2, -y / 2, z))


def _turned(mesh, angle: float):
    """Returns a mesh rotated about the z axis by an angle [rad]."""
    R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    return mesh.rotate(R, (0.0, 0.0, 0.0))


_COUNTS = ("objects", "lost", "table pixels", "false clusters", "no plane")
"""Names of the counts of errors."""


def count_errors(scene: Scene, segmentation: Segmentation) -> Counter:
    """Counts objects without a cluster, and pixels and clusters that belong to the table."""
    cluster = np.zeros(scene.label.shape, dtype=int)
    for number, pixels in enumerate(segmentation.pixels, start=1):
        cluster.flat[pixels] = number
    valid = np.isfinite(scene.depth) & (scene.depth > 0.3) & (scene.depth < 2.5)
    exact = np.where(np.isfinite(scene.exact), scene.exact, 0.0)
    height = (RAYS * exact[..., None]) @ scene.X_WC[2, :3] + scene.X_WC[2, 3]
    count: Counter = Counter(dict.fromkeys(_COUNTS, 0))
    for name in np.unique(scene.label[scene.label >= FIRST]):
        # Border pixels of an object also measure the background; pixels at its base, the table.
        inner = binary_erosion(scene.label == name, iterations=3) & valid
        raised = inner & (height > 0.008)
        if np.count_nonzero(inner) >= 150 and np.median(scene.depth[inner]) <= 2.0:
            count["objects"] += 1
            count["lost"] += not raised.any() or np.mean(cluster[raised] > 0) < 0.5
    table = binary_erosion(scene.label == TABLE, iterations=3) & valid & (abs(height) < 1e-3)
    count["table pixels"] = np.count_nonzero(cluster[table])
    for number in range(1, len(segmentation.pixels) + 1):
        count["false clusters"] += np.mean(scene.label[cluster == number] == TABLE) > 0.5
    count["no plane"] = segmentation.table is None
    return count


@pytest.mark.parametrize("kind", ["mixed", "edge", "large", "cropped"])
def test_objects_are_found_and_the_table_is_no_cluster(kind):
    scene = make_scene(kind, 0)
    count = count_errors(scene, segment_depth(scene.depth, K, None))
    assert count["objects"] > 0
    assert all(count[name] == 0 for name in ("lost", "false clusters", "no plane"))
    assert count["table pixels"] < 30


@pytest.mark.slow
def test_detection_rates_of_all_kinds(monkeypatch):
    # In the labeled images surfaces are measured up to a grazing angle of 80 to 82 degrees.
    monkeypatch.setattr(depth_noise, "_GRAZING_START", np.deg2rad(80.0))
    monkeypatch.setattr(depth_noise, "_GRAZING_END", np.deg2rad(82.0))
    print("\n\n| kind |", " | ".join(_COUNTS), "|")
    total: Counter = Counter()
    for kind in KINDS:
        count: Counter = Counter()
        for seed in range(20):
            scene = make_scene(kind, seed)
            count.update(count_errors(scene, segment_depth(scene.depth, K, None)))
        total.update(count)
        print(f"| {kind} |", " | ".join(str(count[name]) for name in _COUNTS), "|")
    print("| all |", " | ".join(str(total[name]) for name in _COUNTS), "|")
    assert total["lost"] <= 0.01 * total["objects"]
    assert total["no plane"] == 0

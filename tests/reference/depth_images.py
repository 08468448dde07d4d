"""Exact synthetic depth images of boxes on a table, and the poses of their cameras."""

import numpy as np

K = np.array([260.0, 260.0, 159.5, 119.5])
"""Focal lengths fx, fy and principal point cx, cy of the camera [pixel]."""
SIZE = (240, 320)
"""Height and width of the images [pixel]."""


def camera_pose(height: float = 0.8, pitch: float = 0.8, yaw: float = 0.0) -> np.ndarray:
    """Returns the pose X_WC (4, 4) of a camera at (0, 0, height) [m].

    Its optical axis has the azimuth `yaw` and points down by `pitch` [rad].
    """
    c, s = np.cos(pitch), np.sin(pitch)
    z = np.array([c * np.cos(yaw), c * np.sin(yaw), -s])
    x = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    X_WC[2, 3] = height
    return X_WC


def look_at(p_WC, target) -> np.ndarray:
    """Returns the pose X_WC (4, 4) of a camera that looks at a target, with a horizontal x axis."""
    z = np.subtract(target, p_WC) / np.linalg.norm(np.subtract(target, p_WC))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    X_WC[:3, 3] = p_WC
    return X_WC


def rays_of(X_WC: np.ndarray, K, size: tuple[int, int]) -> np.ndarray:
    """Computes the rays (H, W, 3) of the pixels in the world frame, of unit depth [m]."""
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(size)], axis=-1)
    return rays @ X_WC[:3, :3].T


def ray_cast(X_WC: np.ndarray, boxes, table=(0.0, 0.0, 9.0, 9.0), K=K) -> np.ndarray:
    """Computes the exact depth image [m] of a table and axis-aligned boxes.

    Args:
        X_WC: (4, 4) pose of the camera.
        boxes: lower and upper corner of each box [m].
        table: center x, y and half sizes of the rectangle at z = 0 [m].
        K: fx, fy, cx, cy [pixel].
    """
    rays = np.ascontiguousarray(np.moveaxis(rays_of(X_WC, K, SIZE), -1, 0))
    origin = X_WC[:3, 3, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -origin[2] / rays[2]
        x, y = np.abs((origin + depth * rays)[:2] - np.reshape(table[:2], (2, 1, 1)))
        depth = np.where((depth > 0) & (x <= table[2]) & (y <= table[3]), depth, np.inf)
        for low, high in boxes:
            first, second = ((np.reshape(p, (3, 1, 1)) - origin) / rays for p in (low, high))
            enter = np.minimum(first, second).max(axis=0)
            leave = np.maximum(first, second).min(axis=0)
            depth = np.where((enter > 0) & (enter < leave), np.minimum(depth, enter), depth)
    return depth.astype(np.float32)


def box(x: float, y: float, size=(0.1, 0.1, 0.15), z: float = 0.0):
    """Returns the lower and upper corner of a box with its bottom center at (x, y, z) [m]."""
    half = np.array([size[0] / 2, size[1] / 2, 0.0])
    return np.array([x, y, z]) - half, np.array([x, y, z + size[2]]) + half

"""Calibration pictures drawn by known cameras: formulas of our own, no solver, no projectPoints."""

from dataclasses import dataclass

import cv2
import numpy as np

from drake_pose.camera.board import Board, BoardDetections, Detection
from drake_pose.camera.models import look_at

CHECKERBOARD = Board("checkerboard", 8, 5, 0.12)
CHARUCO = Board("charuco", 8, 5, 0.12, marker_length=0.09, dictionary="4X4_50")
SCALE = 50  # picture pixels a square of the drawn board
SUPERSAMPLING = 2


@dataclass
class TrueCamera:
    focal: float
    center: np.ndarray
    distortion: np.ndarray  # k1 k2 p1 p2
    X_WC: np.ndarray
    width: int = 640
    height: int = 480

    def distort(self, xy):
        k1, k2, p1, p2 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def straighten(self, xy):
        ideal = xy.copy()
        for _ in range(30):
            ideal = ideal + (xy - self.distort(ideal))
        return ideal

    def project(self, p_W):
        p_C = (p_W - self.X_WC[:3, 3]) @ self.X_WC[:3, :3]
        return self.distort(p_C[:, :2] / p_C[:, 2:]) * self.focal + self.center


def ring(count, generator, radius=2.5, spread=360.0, distorted=True):
    """Cameras on part of a circle, which look at its middle, 1.2 m up."""
    cameras = {}
    for i in range(count):
        angle = np.radians(spread * i / count)
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.5])
        k = generator.uniform([-0.25, -0.02, -0.002, -0.002], [-0.1, 0.08, 0.002, 0.002])
        cameras[f"c{i}"] = TrueCamera(
            focal=generator.uniform(480, 620),
            center=np.array([320, 240]) + generator.uniform(-15, 15, 2),
            distortion=k if distorted else np.zeros(4),
            X_WC=look_at(eye, [0.0, 0.0, 1.2]),
        )
    return cameras


def board_pose(board, generator, towards):
    """A board near the middle of the ring that faces `towards` (3,), turned at random."""
    tilt = cv2.Rodrigues(generator.uniform(-0.35, 0.35, 3))[0]
    z = np.asarray(towards, float) - [0, 0, 1.2]
    z /= np.linalg.norm(z)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([x, np.cross(z, x), z]) @ tilt
    middle = np.array([board.columns, board.rows, 0]) * 0.5 * board.square_length
    X[:3, 3] = np.array([0, 0, 1.2]) - X[:3, :3] @ middle + generator.uniform(-0.25, 0.25, 3)
    return X


def facing(X_WB, camera, limit=0.5):
    """Whether a camera sees the printed side at less than about 60 degrees."""
    away = camera.X_WC[:3, 3] - X_WB[:3, 3]
    return away @ X_WB[:3, 2] / np.linalg.norm(away) > limit


def inside(uv, camera, margin=12):
    return bool(
        (uv > margin).all() and (uv < [camera.width - margin, camera.height - margin]).all()
    )


def poses_for_pairs(cameras, board, generator, count):
    """Board poses that face the gap between neighbours, in turn."""
    eyes = [camera.X_WC[:3, 3] for camera in cameras.values()]
    return {
        f"{k:04d}": board_pose(
            board, generator, 0.5 * (eyes[k % len(eyes)] + eyes[(k + 1) % len(eyes)])
        )
        for k in range(count)
    }


def sightings_of(cameras, board, poses, generator, noise=0.1):
    """What a perfect detector with some noise would find."""
    found = {name: {} for name in cameras}
    for frame, X_WB in poses.items():
        p_W = board.points @ X_WB[:3, :3].T + X_WB[:3, 3]
        for name, camera in cameras.items():
            uv = camera.project(p_W)
            if facing(X_WB, camera) and inside(uv, camera):
                uv = uv + generator.normal(0, noise, uv.shape)
                found[name][frame] = Detection(np.arange(len(uv)), uv)
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    return BoardDetections(board, sizes, found)


def drawn_board(board):
    """The printed board as a picture with a margin of one square."""
    if board.kind == "charuco":
        size = (board.columns * SCALE, board.rows * SCALE)
        picture = board.opencv_charuco_board().generateImage(size)
    else:
        row, column = np.indices((board.rows * SCALE, board.columns * SCALE)) // SCALE
        picture = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
    return cv2.copyMakeBorder(picture, SCALE, SCALE, SCALE, SCALE, cv2.BORDER_CONSTANT, value=255)


def photograph(camera, board, X_WB, generator, noise=2.0):
    """The picture (H, W) of a board by a camera with distortion, blur and noise."""
    n = SUPERSAMPLING
    v, u = np.indices((camera.height * n, camera.width * n)).astype(float)
    fine = np.stack([(u + 0.5) / n - 0.5, (v + 0.5) / n - 0.5], axis=-1)
    coarse = camera.straighten((fine[::8, ::8] - camera.center) / camera.focal)
    # Distortion is smooth: every eighth ray is solved for, those between are interpolated.
    where = np.stack([u, v], axis=-1).astype(np.float32) / 8
    ideal = cv2.remap(
        coarse.astype(np.float32), where[..., 0], where[..., 1], cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    X_CB = np.linalg.inv(camera.X_WC) @ X_WB
    plane = np.linalg.inv(np.column_stack([X_CB[:3, 0], X_CB[:3, 1], X_CB[:3, 3]]))
    on_board = ideal @ plane[:, :2].T.astype(np.float32) + plane[:, 2].astype(np.float32)
    xy = on_board[..., :2] / on_board[..., 2:] / board.square_length
    # Drawn pixel k covers k - 0.5 to k + 0.5; the board's frame has y up from its lower edge.
    across = (xy[..., 0] + 1.0) * SCALE - 0.5
    down = (board.rows - xy[..., 1] + 1.0) * SCALE - 0.5
    seen = cv2.remap(
        drawn_board(board), across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=150,
    )  # fmt: skip
    seen = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(seen, (0, 0), 0.6).astype(float)
    return np.clip(seen * 0.8 + 20 + generator.normal(0, noise, seen.shape), 0, 255).astype(
        np.uint8
    )

"""The bundled hands, and states of them."""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.filtering.hand_model import HandModel, read_hand


@cache
def right_hand() -> tuple[ArticulatedModel, HandModel]:
    model = load_model(bundled_model("hand").with_name("right_hand.urdf"), check=False)
    return model, read_hand(model)


def hand_at(hand: HandModel, quaternion, angles=0.0) -> np.ndarray:
    """Return the state of a hand at rest of its model's sizes, lengths of 5 cm if it has none."""
    layout = hand.layout
    x = np.zeros(len(layout))
    x[2:6], x[layout.indices(hand.angles)] = quaternion, angles
    x[layout.indices(layout.constant)] = [hand.sizes.get(name, 0.05) for name in layout.constant]
    return x


def random_hand(hand: HandModel, seed: int, stretch: float = 0.0) -> np.ndarray:
    """Return a random state; ``stretch``: by which sizes differ from the model's, relative."""
    generator = np.random.default_rng(seed)
    quaternion = Rotation.random(rng=generator).as_quat() * generator.uniform(0.9, 1.1)
    x = hand_at(hand, quaternion, generator.uniform(-0.1, 0.8, len(hand.angles)))
    x[:2] = generator.uniform(-60, 60, 2)
    sizes = hand.layout.indices(hand.layout.constant)
    x[sizes] *= generator.uniform(1.0 - stretch, 1.0 + stretch, len(sizes))
    return x

"""Whether one pose fits significantly worse than another that it is no special case of.

Vuong's test (1989): the costs of both are compared piece by piece of the pictures, and how their
differences scatter from piece to piece tells how large that of the whole may be by chance. What no
pose explains costs all of them alike and says nothing.
"""

import math

import numpy as np

_ROUNDING = 1e-9


def excess(pieces: np.ndarray, others: np.ndarray) -> float:
    """By how many standard deviations costs by pieces are above others of the same shape."""
    more = pieces - others
    return float(more.sum() / max(math.sqrt(float((more**2).sum())), _ROUNDING))

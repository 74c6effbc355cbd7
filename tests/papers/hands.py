"""Runs of Shimada's experiments that several tests read."""

from functools import cache

from drake_pose.papers.shimada import HypothesesResult, run_hypotheses_experiment
from drake_pose.papers.shimada_sequences import experiment_settings


@cache
def followed_hypotheses() -> HypothesesResult:
    """Return the hypotheses of 12 sequences, by one linearisation a frame, as in the paper."""
    return run_hypotheses_experiment(12, 0, experiment_settings("sequential", 1))

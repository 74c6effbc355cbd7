"""Belief within limits: a Kalman filter whose estimates respect linear inequalities."""

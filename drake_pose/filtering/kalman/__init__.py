"""The Kalman filter: update, hypotheses, and truncation after each step."""

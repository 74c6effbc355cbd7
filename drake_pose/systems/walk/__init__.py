"""The walk-through: a captured person walks through a garden by gestures."""

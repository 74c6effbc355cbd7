"""Figures as people read them, alike in tables and warnings."""


def percent(share: float | None) -> str:
    """Returns a share in percent, or a dash."""
    return "-" if share is None else f"{100.0 * share:.2f} %"

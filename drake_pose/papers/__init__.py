"""The papers' experiments: their figures beside ours."""

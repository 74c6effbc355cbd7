"""The result folder: tables, motion files, pages, overlays and the summary."""

"""Model files (URDF, SDFormat, MJCF, directives) made fit for Drake, and parsed."""

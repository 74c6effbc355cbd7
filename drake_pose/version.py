"""The version of drake_pose."""

VERSION = "0.1.0"

"""The commands of `drake-pose`: their options, and what they print."""

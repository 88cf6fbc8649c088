"""mavquad: a MAVLink companion that estimates what the autopilot does not say. Importing it imports nothing else."""

__version__ = "0.1.0"

"""The simulated autopilot: a program of its own, met over MAVLink only."""

"""Bytes and time: endpoints, clocks, logs, and the translation of MAVLink fields into signals."""

"""Compensators: correct the command of any nominal controller."""

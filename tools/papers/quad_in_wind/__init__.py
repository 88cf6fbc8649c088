"""The quadrotor of paper 003 in turbulent wind: its own plant, compiled whole, for that paper's experiments.

The flight simulator `sitl/` has another wind of its own: written twice on purpose, so that an error in one shows.
"""

"""Observers: from samples to states, rates and disturbances."""

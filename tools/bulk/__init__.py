"""Whole flights inside one process, without frames and sockets: compiled (fused) or stage by stage in Python (stepwise), equal results."""

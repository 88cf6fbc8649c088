"""The last stage before the wire."""

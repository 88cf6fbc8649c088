"""Campaigns: the file (grid), what is drawn (draw), the flights' rows (store), processes (workers), engines (over_udp), statistics."""

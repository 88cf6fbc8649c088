"""The IADRC paper's experiments: vehicles, configurations, the fused closed loop, figures of merit, report."""

"""A controller that does not predict, on a link whose delay takes its phase: it flies its slowest design. Pure.

`slowing` is for our own lateness, which comes and goes with every gap; a link's delay is measured by TIMESYNC, stays, and costs its
whole length. Those that predict (`eskf-mpc`, `iadrc`) fly through it. Measured, `pid` on the x500, a circle, delay each way and
position rmse as designed and slowed: 100 ms 0.09, 0.15 m; 150 ms 0.69 (a circle within the circle), 0.32 m; 240 ms 2.19, 0.52 m.
"""

import dataclasses

from mavquad import slowing
from mavquad.plan import Plan

_SLOW, _QUICK = 1.6, 1.2  # of the vehicle's own lag: a delay beyond slows, below speeds up again


def adapt(plan: Plan, delay_s: float) -> Plan:
    """The plan to fly with at this delay (to the autopilot and back): the same one where nothing changes."""
    stage = plan.controller
    fields = {field.name for field in dataclasses.fields(stage.params)}
    if plan.settings.controller == "autopilot":  # its own loops fly
        return plan
    if "wc_rad_s" not in fields or getattr(stage.params, "predict", False):
        return plan
    own_s, slow = slowing.own_s(plan.airframe), slowed(plan)
    if delay_s > _SLOW * own_s and not slow:
        slowest = plan.slowed[-1]
        return plan._replace(controller=stage._replace(gains=slowest), slowed=(slowest,) * len(plan.slowed))
    if delay_s < _QUICK * own_s and slow:
        gains = stage.module.gains(stage.params, plan.airframe)
        return plan._replace(
            controller=stage._replace(gains=gains), slowed=slowing.designs(stage.module, stage.params, plan.airframe)
        )
    return plan


def slowed(plan: Plan) -> bool:
    """Whether this plan flies the slowest design for its delay."""
    return plan.controller.gains is plan.slowed[-1]

"""The table from the kind of a scene to the function that plans it."""

from __future__ import annotations

from collections.abc import Callable

from clrecon.phantom.scenes import Part, Plan
from clrecon.phantom.settings import PhantomSettings
from clrecon.phantom.skull import plan_dry_skull, plan_head
from clrecon.phantom.tables import lay_under
from clrecon.phantom.trunk import plan_bones, plan_contrast, plan_limb, plan_nothing, plan_pair, plan_pelvis, plan_water

PLANS: dict[str, Callable[[], Plan]] = {
    "skull": plan_dry_skull,
    "head": plan_head,
    "bones": plan_bones,
    "limb": plan_limb,
    "pair": plan_pair,
    "pelvis": plan_pelvis,
    "contrast": plan_contrast,
    "water": plan_water,
    "empty": plan_nothing,
}
"""The planning function of each kind of `clrecon.phantom.settings.KINDS` that is a scene."""


def plan_scene(settings: PhantomSettings) -> list[Part]:
    """Plan all parts of the scene in the order of painting: the table first, then the body that lies on it."""
    plan = PLANS[settings.kind]()
    table = lay_under(plan, settings.table_used, settings.table_gap_mm, settings.prone)
    return [*table, *plan.parts]

"""Masking of a scan before a surface or a picture is made: table and surroundings, and everything outside the view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from clrecon.jobs.shared.settings import InputSettings
from clrecon.system.progress import Progress
from clrecon.system.text import format_digits

if TYPE_CHECKING:
    from clrecon.geometry import Volume


def mask_volume(volume: Volume, settings: InputSettings, progress: Progress) -> Volume:
    """Return the volume with air outside the field of view and the body, as the settings ask for it."""
    if settings.field_of_view is None and not settings.remove_table:
        return volume
    from clrecon.anatomy.body import describe_pieces, mask_field_of_view, remove_table
    from clrecon.geometry.certificate import amend

    warnings = list(volume.report.get("warnings", ()))
    if settings.field_of_view is not None:
        radius = settings.field_of_view
        volume = mask_field_of_view(volume, None if isinstance(radius, str) else radius, progress=progress)
        facts = volume.report["field_of_view"]
        warnings.append(
            f"outside of {format_digits(facts['radius_mm'], 4)} mm around the centre of the slices is air now:"
            f" {100.0 * facts['removed_share']:.3g} % of the voxels, {facts['dense_voxels_removed']:,} of them dense"
            + _describe_cut(facts)
        )
    if settings.remove_table:
        volume = remove_table(volume, allow_bone_loss=settings.allow_bone_loss, progress=progress)
        facts = volume.report["remove_table"]
        warnings.append(
            f"outside of the body is air now: {100.0 * facts['removed_share']:.3g} % of the voxels,"
            f" {facts['dense_voxels_removed']:,} of them dense (table, blankets);{_describe_bone(facts)}"
            " look whether the body is whole"
        )
        if facts["kept_without_bone"]:
            warnings.append(
                f"kept beside the body: pieces without bone, {describe_pieces(facts['kept_without_bone'])}; they may be"
                " equipment as thick as a limb, such as paddles of a fixation mask"
            )
    volume.report = amend(volume.report, warnings=warnings)
    return volume


def _describe_bone(facts: dict[str, Any]) -> str:
    from clrecon.anatomy.body import describe_pieces

    if facts["bone_kept"] is None:
        return " no bone above 300 HU;"
    what = "the dry bone" if facts["specimen"] else "the bone"
    removed = f"{facts['bone_voxels_removed']:,} voxels removed"
    if facts["bone_removed"]:
        removed += f": {describe_pieces(facts['bone_removed'])}"
    return f" of {what} {100.0 * facts['bone_kept']:.4g} % stay ({removed});"


def _describe_cut(facts: dict[str, Any]) -> str:
    """Describe the bone that a circle has cut off; no text if it has cut off none."""
    lost = facts["bone_voxels_removed"]
    if not lost:
        return ""
    apart = facts["bone_voxels_apart"]
    whole = f", {apart:,} of them in pieces that lie outside whole" if apart else ""
    return f"; it cuts bone off: {100.0 * (1.0 - facts['bone_kept']):.3g} %, {lost:,} voxels above 300 HU{whole}"

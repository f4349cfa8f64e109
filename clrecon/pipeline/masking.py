"""What of the scan is left out before a surface or a picture is made: what is not the patient, what is not in view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clrecon.pipeline.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.pipeline.render_settings import RenderSettings
    from clrecon.pipeline.settings import MeshSettings

__all__ = ["mask_volume"]


def mask_volume(volume: Volume, settings: MeshSettings | RenderSettings, progress: Progress) -> Volume:
    """The volume with air outside of the field of view and of the body, as far as the settings ask for it.

    Raises
    ------
    UsageError
        The field of view holds nothing.
    RefusedInputError
        There is no body to be told from its table.
    """
    if settings.field_of_view is None and not settings.remove_table:
        return volume
    from clrecon.geometry.body import mask_field_of_view, remove_table

    progress("mask", 0, 0)
    warnings = list(volume.report["warnings"])
    if settings.field_of_view is not None:
        radius = settings.field_of_view
        volume = mask_field_of_view(volume, None if isinstance(radius, str) else radius)
        facts = volume.report["field_of_view"]
        warnings.append(
            f"outside of {facts['radius_mm']:.4g} mm around the centre of the slices is air now:"
            f" {100.0 * facts['removed_share']:.3g} % of the voxels, {facts['dense_voxels_removed']:,} of them dense"
        )
    if settings.remove_table:
        volume = remove_table(volume)
        facts = volume.report["remove_table"]
        warnings.append(
            f"outside of the body is air now: {100.0 * facts['removed_share']:.3g} % of the voxels,"
            f" {facts['dense_voxels_removed']:,} of them dense (table, blankets); look whether the body is whole"
        )
    volume.report["warnings"] = warnings
    return volume

"""Pictures along rays: volume rendering, projections, surfaces, slices in space."""

/* Vertices of a surface without labels: the field places them all. */
#ifndef CLRECON_NO_BORDER_H
#define CLRECON_NO_BORDER_H

#include "surface/vertex_group.h"

typedef struct {
    int unused;
} surface_border;

#define BORDER_PARAMETERS
#define SURFACE_BORDER { 0 }
#define BORDER_GOES_ON 0

static inline uint gather_border(
    vertex_group *group, uint n, const volume_part *volume, const surface_border *none, int i, int j, int k, int axis,
    int inner)
{
    return 0;
}

static inline void count_half_way(const surface_border *none, const uint half_way) {}

#endif

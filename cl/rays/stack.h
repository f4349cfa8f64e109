/* Uneven slices: conversion of field coordinates, see rays/view.h, to voxel indices.
 *
 * -D UNEVEN: `slices` has 4 float4 a slice: height over slice 0 in mm, indices (i, j) by which its voxel (0, 0) lies
 * beside that of slice 0, 1 / height to the next slice; and three rows, see VIEW_NORMAL_X.  Without it field
 * coordinates are indices. */
#ifndef CLRECON_STACK_H
#define CLRECON_STACK_H

#include "include/lanes.h"

typedef struct {
    __global const float4 *slices;
    __global const int *layers; /* for heights in equal steps: a slice at or below, at most some few slices below */
    float layers_per_mm;
    int layer_count, nk;
} slice_stack;

/* The parameters of a kernel for the table, and the table itself. */
#ifdef UNEVEN
#define STACK_PARAMETERS \
    , __global const float4 *restrict stack_slices, __global const int *restrict stack_layers, \
        const float layers_per_mm, const int layer_count, const int stack_nk
#define STACK_TABLE { stack_slices, stack_layers, layers_per_mm, layer_count, stack_nk }
#else
#define STACK_PARAMETERS
#define STACK_TABLE { 0, 0, 0.0f, 0, 0 }
#endif

/* Layer of slices that a height lies in; the first and the last go on without end. */
static inline int find_layer(const slice_stack *s, const float height)
{
    int layer = s->layers[clamp((int)(height * s->layers_per_mm), 0, s->layer_count - 1)];
    while (layer < s->nk - 2 && height >= s->slices[4 * (layer + 1)].x)
        ++layer;
    return layer;
}

/* Field coordinates of LANES places to indices, in place. */
static inline void to_indices(const slice_stack *s, floats *i, floats *j, floats *k)
{
#ifdef UNEVEN
    float lane_i[LANES], lane_j[LANES], lane_k[LANES];
    store_lanes(*i, lane_i);
    store_lanes(*j, lane_j);
    store_lanes(*k, lane_k);
    for (int lane = 0; lane < LANES; ++lane) {
        const int layer = find_layer(s, lane_k[lane]);
        const float4 below = s->slices[4 * layer], above = s->slices[4 * layer + 4];
        const float part = (lane_k[lane] - below.x) * below.w;
        lane_i[lane] -= below.y + part * (above.y - below.y);
        lane_j[lane] -= below.z + part * (above.z - below.z);
        lane_k[lane] = (float)layer + part;
    }
    *i = load_lanes(lane_i);
    *j = load_lanes(lane_j);
    *k = load_lanes(lane_k);
#endif
}

#endif

/* How open the places of a volume are: a grid of the share of light from all around that reaches them, by which hollows
 * are darkened (ambient occlusion).
 *
 * References: Zhukov, Iones and Kronin 1998, "An ambient light illumination model" (obscurances: what is far away hides
 * less); Hernell, Ljung and Ynnerman 2010, "Local ambient occlusion in direct volume rendering".  Light comes from the
 * 26 directions to the neighbours of a cell, with the weights of Lebedev's quadrature of 26 points.
 *
 *      x <- . <- . <- . <- light     hidden(x) = keep * (density(y) + (1 - density(y)) * hidden(y)), y towards the light:
 *           y                        an opaque cell at a distance hides exp(-distance / reach)
 *
 * Passes: fill_cells; sweep_light for each direction; finish_openness.
 *
 * -D LABELS   labels with opacities */
#include "include/label_type.h"
#include "include/volume.h"

#define OPEN_FREE 0.75f /* share of the light around a place before a wall that counts as the open */

#ifdef LABELS
#define LABEL_PARAMETERS , __global const LABEL *restrict labels, __global const float4 *restrict label_colors
#define LABEL_FACTOR(at) label_colors[labels[at]].w
#else
#define LABEL_PARAMETERS
#define LABEL_FACTOR(at) 1.0f
#endif

/* Parameters  voxels    in   (nk, nj, ni)
 *             opacities in   (last_node + 1) of a voxel of each node over the length of a cell
 *             shown     in   (gk, gj, gi) 0 where a cell is cut away; read only with `is_clipped`
 *             density   out  (gk, gj, gi) mean opacity of the voxels of each cell
 *             open      out  (gk, gj, gi) 0
 *             with LABELS labels (nk, nj, ni), label_colors: see rays/label_color.h
 *             low scale nearest node to a value v: (v - low) * scale + 0.5
 *             ci cj ck  voxels of a cell along i, j, k;  first, count: the cells that are filled; first voxel is theirs
 * Launch      global = count rounded up by the host, any local
 * Guarantees  each cell from `first` on is written; the same bits on all devices */
__kernel void fill_cells(
    __global const VOXEL *restrict voxels, __global const float *restrict opacities, __global const uchar *restrict shown,
    __global float *restrict density, __global float *restrict open, const float low, const float scale,
    const int last_node, const int is_clipped, const int ni, const int nj, const int nk, const int gi, const int gj,
    const int ci, const int cj, const int ck, const uint first, const uint count LABEL_PARAMETERS)
{
    const uint cell = (uint)get_global_id(0);
    if (cell >= count)
        return;
    const int begin_i = (int)(cell % (uint)gi) * ci, begin_j = (int)(cell / (uint)gi % (uint)gj) * cj;
    const int begin_k = (int)(cell / (uint)gi / (uint)gj) * ck;
    const int end_i = min(begin_i + ci, ni), end_j = min(begin_j + cj, nj), end_k = min(begin_k + ck, nk);
    float sum = 0.0f;
    for (int k = begin_k; k < end_k; ++k)
        for (int j = begin_j; j < end_j; ++j) {
            const size_t row = voxel_index(0, j, k, ni, nj);
            for (int i = begin_i; i < end_i; ++i) {
                const float node = floor(((float)voxels[row + i] - low) * scale + 0.5f);
                sum += opacities[(int)clamp(node, 0.0f, (float)last_node)] * LABEL_FACTOR(row + i);
            }
        }
    const int is_cut = is_clipped && !shown[first + cell];
    density[first + cell] = is_cut ? 0.0f : sum / (float)((end_i - begin_i) * (end_j - begin_j) * (end_k - begin_k));
    open[first + cell] = 0.0f;
}

/* Parameters  density  in      (gk, gj, gi)
 *             open     in/out  (gk, gj, gi) `weight` times what reaches a cell from the direction is added
 *             di dj dk towards the light, -1 to 1 each, not all 0
 *             keep     what is left of what is hidden after a step
 * Launch      global = lines across the last of k, j, i that the direction has, rounded up by the host, any local
 * Guarantees  each cell is on one line, which leaves the grid at one side and comes in again at the other, in the open;
 *             the same bits on all devices */
__kernel void sweep_light(
    __global const float *restrict density, __global float *restrict open, const int di, const int dj, const int dk,
    const float keep, const float weight, const int gi, const int gj, const int gk)
{
    const int line = (int)get_global_id(0);
    const int lines = dk != 0 ? gi * gj : dj != 0 ? gi * gk : gj * gk;
    if (line >= lines)
        return;
    const int across = dk != 0 || dj != 0 ? gi : gj;
    const int first = line % across, second = line / across;
    /* Lines begin where the light comes in. */
    const int far_i = di > 0 ? gi - 1 : 0, far_j = dj > 0 ? gj - 1 : 0, far_k = dk > 0 ? gk - 1 : 0;
    int i = dk != 0 || dj != 0 ? first : far_i;
    int j = dk != 0 ? second : dj != 0 ? far_j : first;
    int k = dk != 0 ? far_k : second;
    float hidden = 0.0f, before = 0.0f;
    const int steps = dk != 0 ? gk : dj != 0 ? gj : gi;
    for (int step = 0; step < steps; ++step) {
        const size_t cell = voxel_index(i, j, k, gi, gj);
        hidden = keep * (before + (1.0f - before) * hidden);
        before = density[cell];
        open[cell] += weight * (1.0f - hidden);
        i -= di;
        j -= dj;
        k -= dk;
        if (i < 0 || i >= gi || j < 0 || j >= gj) {
            i = i < 0 ? gi - 1 : i >= gi ? 0 : i;
            j = j < 0 ? gj - 1 : j >= gj ? 0 : j;
            hidden = before = 0.0f;
        }
    }
}

/* Parameters  open      in   (gk, gj, gi) share of the light around each cell
 *             openness  out  (gk, gj, gi) square of the most of it in a cell and those around it, from 0 to `whole`:
 *                            surfaces are as open as the places before them, and hollows are clearly darker
 * Launch      global = gi * gj * gk rounded up by the host, any local
 * Guarantees  every cell is written; the same bits on all devices */
__kernel void finish_openness(
    __global const float *restrict open, __global VOXEL *restrict openness, const float whole, const int gi,
    const int gj, const int gk)
{
    const size_t cell = get_global_id(0);
    if (cell >= (size_t)gi * (size_t)gj * (size_t)gk)
        return;
    const int i = (int)(cell % (size_t)gi), j = (int)(cell / (size_t)gi % (size_t)gj);
    const int k = (int)(cell / (size_t)gi / (size_t)gj);
    float most = 0.0f;
    for (int at_k = max(k - 1, 0); at_k <= min(k + 1, gk - 1); ++at_k)
        for (int at_j = max(j - 1, 0); at_j <= min(j + 1, gj - 1); ++at_j)
            for (int at_i = max(i - 1, 0); at_i <= min(i + 1, gi - 1); ++at_i)
                most = max(most, open[voxel_index(at_i, at_j, at_k, gi, gj)]);
    const float share = min(most / OPEN_FREE, 1.0f);
    openness[cell] = (VOXEL)floor(whole * share * share + 0.5f);
}

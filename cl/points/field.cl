/* A signed distance around points with normals, on nodes: the field of which a surface from a cloud is the level 0.
 *
 *      f(x) = sum w <x - p, n> / sum w,   w = (1 - d^2 / R^2)^2 / (d^2 + s^2),   d = |x - p| < R
 *
 * Reference: Hoppe et al. 1992, "Surface reconstruction from unorganized points", for the distance from tangent planes;
 * Shen, O'Brien and Shewchuk 2004, "Interpolating and approximating implicit surfaces from polygon soup", for 1/(d^2 + s^2).
 *
 * Nodes are worked on in bricks of 8 x 4 x 4, and only in those that a point reaches:
 *
 *      . . . . . . . .      brick 0 is idle: no cell with points lies within R of its nodes
 *      . . o o o . . .      o: nodes near a point.  A row of a brick is a byte of the masks and a vector of 8 floats
 *      . o * * * o . .      *: nodes within one spacing of a point, the core
 *      | 8 nodes  |
 *
 * Passes
 *   1. merge_rows, mark_reached    bricks that points reach, by the bits of the grid's cells (then compact.cl: a list)
 *   2. sort_normals               normals in the order of the grid
 *   3. measure_nodes              f of each node of these bricks, and the masks near, core, negative
 *   (the signs of all nodes: field_signs.cl)
 *   4. fill_far, place_bricks     the volume: |f|, positive inside and negative outside, and +-B where no point is near
 *
 * The points of a node are added in the order of the grid, and those without weight add 0: f does not depend on the bricks
 * or on the slabs.  LANES 8: an item takes a brick, and gathers its points in private arrays first.  LANES 1: an item takes
 * a row of a brick, and reads the points where they are. */

#include "points/grid.h"

#ifndef LANES
#define LANES 1
#endif

#define BRICK_LONG 8   /* nodes of a brick along x */
#define BRICK_WIDE 4   /* along y and along z */
#define BRICK_ROWS 16  /* rows of a brick */
#define BRICK_NODES 128
#define GATHERED 256   /* points that are gathered together; more are worked on in turn */

/* Cells between two places along an axis, cut at the grid: empty where .x > .y. */
static inline int2 cells_between(const float low, const float high, const float origin, const float scale, const int n)
{
    return (int2)(
        (int)clamp(floor((low - origin) * scale), 0.0f, (float)n),
        (int)clamp(floor((high - origin) * scale), -1.0f, (float)(n - 1)));
}

/* Brick (x, y, z) of a position in the mask of bricks. */
static inline int4 brick_at(const uint position, const uint bricks_y, const uint brick_words)
{
    const uint word = position >> 5, row = word / brick_words;
    return (int4)((int)((word % brick_words) << 5 | (position & 31)), (int)(row % bricks_y), (int)(row / bricks_y), 0);
}

/* Parameters  mask    in   (nz, ny, words) the grid's cells with points
 *             merged  out  (bricks_z, bricks_y, words) cells with points in the rows that reach a row of bricks
 *             nodes   place of node (0, 0, 0) relative to the grid's base, spacing
 *             origin  corner of cell (0, 0, 0), 1 / edge;  ny nz words: of the grid
 *             within  R and a little more, for the rounding of cells
 *             bricks_y bricks_z    bricks along the axes
 * Launch      global = bricks_z * bricks_y * words rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void merge_rows(
    __global const uint *restrict mask, __global uint *restrict merged, const float4 nodes, const float4 origin,
    const int ny, const int nz, const int words, const float within, const uint bricks_y, const uint bricks_z)
{
    const uint item = get_global_id(0);
    const uint row = item / (uint)words, word = item % (uint)words;
    if (row >= bricks_y * bricks_z)
        return;
    const float y = nodes.y + nodes.w * (float)(row % bricks_y * BRICK_WIDE);
    const float z = nodes.z + nodes.w * (float)(row / bricks_y * BRICK_WIDE);
    const float long_way = nodes.w * (BRICK_WIDE - 1) + within;
    const int2 over_y = cells_between(y - within, y + long_way, origin.y, origin.w, ny);
    const int2 over_z = cells_between(z - within, z + long_way, origin.z, origin.w, nz);
    uint bits = 0;
    for (int cell_z = over_z.x; cell_z <= over_z.y; ++cell_z)
        for (int cell_y = over_y.x; cell_y <= over_y.y; ++cell_y)
            bits |= mask[grid_row(cell_y, cell_z, ny, words) + word];
    merged[item] = bits;
}

/* Parameters  merged  in   (bricks_z, bricks_y, words)
 *             bricks  out  (bricks_z, bricks_y, brick_words) bit b of word w: points may reach brick 32 w + b of the row
 *             nx      cells of a row;  bricks_x: bricks of a row;  rows: bricks_z * bricks_y
 *             nodes origin words within    as in merge_rows
 * Launch      global = rows * brick_words rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void mark_reached(
    __global const uint *restrict merged, __global uint *restrict bricks, const float4 nodes, const float4 origin,
    const int nx, const int words, const float within, const uint bricks_x, const uint brick_words, const uint rows)
{
    const uint item = get_global_id(0);
    const uint row = item / brick_words, first = item % brick_words * 32;
    if (row >= rows)
        return;
    const uint count = min(32u, bricks_x - first);
    uint marked = 0;
    for (uint bit = 0; bit < count; ++bit) {
        const float x = nodes.x + nodes.w * (float)((first + bit) * BRICK_LONG);
        const int2 cells = cells_between(
            x - within, x + (nodes.w * (BRICK_LONG - 1) + within), origin.x, origin.w, nx);
        uint found = 0;
        for (int word = cells.x >> 5; word <= cells.y >> 5 && cells.x <= cells.y; ++word) {
            uint bits = merged[row * (uint)words + (uint)word];
            if (word == cells.x >> 5)
                bits &= 0xffffffffu << (cells.x & 31);
            if (word == cells.y >> 5)
                bits &= 0xffffffffu >> (31 - (cells.y & 31));
            found |= bits;
        }
        marked |= (uint)(found != 0) << bit;
    }
    bricks[item] = marked;
}

/* Parameters  normals     in   (n, 3) unit vectors in the order of the input
 *             order       in   (n,) number of the point at each place of the grid's order
 *             nx ny nz    out  (n,) in the grid's order
 *             n           points
 * Launch      global = n rounded up by the host, any local */
__kernel void sort_normals(
    __global const float *restrict normals, __global const uint *restrict order, __global float *restrict nx,
    __global float *restrict ny, __global float *restrict nz, const uint n)
{
    const uint place = get_global_id(0);
    if (place >= n)
        return;
    const float3 normal = vload3(order[place], normals);
    nx[place] = normal.x;
    ny[place] = normal.y;
    nz[place] = normal.z;
}

/* The points with their normals in the order of their grid, the nodes, and what a point counts; see measure_nodes. */
typedef struct {
    __global const uint *mask, *ranks, *starts;
    __global const float *px, *py, *pz, *nx, *ny, *nz;
    float4 nodes, origin;
    int cells_x, cells_y, cells_z, words;
    float within, squared_reach, per_squared_reach, squared_smoothing;
} field_grid;

/* What is written of a row of nodes, and by what it is decided. */
typedef struct {
    __global float *values;
    __global uchar *near, *core, *negative;
    uint nodes_y, node_words;
    float squared_bridge, squared_spacing;
} field_rows;

/* Rows of nodes with all cells whose points may reach them. */
typedef struct {
    float8 x;
    float3 low, high; /* of the nodes */
    int2 over_x, over_y, over_z; /* cells, the last one included */
} node_block;

/* The block that begins with node `first`, `rows` rows wide along y and z. */
static inline node_block find_block(const field_grid *g, const int4 first, const int rows)
{
    const float spacing = g->nodes.w;
    const float8 x = g->nodes.x + (convert_float8((int8)(0, 1, 2, 3, 4, 5, 6, 7) + first.x) * spacing);
    const float3 low = (float3)(x.s0, g->nodes.y + (float)first.y * spacing, g->nodes.z + (float)first.z * spacing);
    const float3 high = (float3)(
        x.s7, g->nodes.y + (float)(first.y + rows - 1) * spacing, g->nodes.z + (float)(first.z + rows - 1) * spacing);
    const float4 origin = g->origin;
    const int2 over_x = cells_between(low.x - g->within, high.x + g->within, origin.x, origin.w, g->cells_x);
    const int2 over_y = cells_between(low.y - g->within, high.y + g->within, origin.y, origin.w, g->cells_y);
    const int2 over_z = cells_between(low.z - g->within, high.z + g->within, origin.z, origin.w, g->cells_z);
    const node_block block = {x, low, high, over_x, over_y, over_x.x > over_x.y ? (int2)(0, -1) : over_z};
    return block;
}

/* First point of the cells (over_x, cell_y, cell_z), and the one after the last. */
static inline uint2 points_over(const field_grid *g, const int2 over_x, const int cell_y, const int cell_z)
{
    const uint row = grid_row(cell_y, cell_z, g->cells_y, g->words);
    const uint2 cells = grid_window(g->mask, g->ranks, row, over_x.x, over_x.y);
    return (uint2)(g->starts[cells.x], g->starts[cells.y]);
}

/* What the nodes of a row have so far: sums of weighted heights and of weights, squared distance of the nearest point. */
typedef struct {
    float8 heights, weights, nearest;
} RowSums;

/* Add a point at x = `place` to a row of nodes at `x`.  `square` is its squared distance in y and z, `height` that part of
 * <x - p, n>. */
static inline RowSums add_point(
    RowSums sums, const field_grid *g, const float8 x, const float place, const float square, const float nx,
    const float height)
{
    const float8 along = x - place;
    const float8 squared = along * along + square;
    const float8 rest = 1.0f - squared * g->per_squared_reach;
    const float8 inner = rest > 0.0f ? rest : 0.0f;
    const float8 weight = inner * inner / (squared + g->squared_smoothing);
    sums.heights += weight * (along * nx + height);
    sums.weights += weight;
    sums.nearest = squared < sums.nearest ? squared : sums.nearest;
    return sums;
}

/* The bits of a row of a brick. */
static inline uchar row_bits(const int8 condition)
{
    const int8 bits = condition & (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    const int4 halves = bits.lo | bits.hi;
    const int2 pairs = halves.lo | halves.hi;
    return (uchar)(pairs.x | pairs.y);
}

/* Write f of row `row` of a brick, which is number `place` of the list, and its bits. */
static inline void write_row(
    const field_rows *out, const RowSums sums, const uint place, const int4 brick, const uint row)
{
    const int8 is_near = (sums.weights > 0.0f) & (sums.nearest <= out->squared_bridge);
    const float8 mean = sums.weights > 0.0f ? sums.heights / sums.weights : 0.0f;
    const size_t node_row = (size_t)(brick.z * BRICK_WIDE + (int)(row / BRICK_WIDE)) * out->nodes_y
                            + (size_t)(brick.y * BRICK_WIDE + (int)(row % BRICK_WIDE));
    const size_t byte = node_row * (4 * out->node_words) + (size_t)brick.x;
    vstore8(mean, (size_t)place * BRICK_ROWS + row, out->values);
    out->near[byte] = row_bits(is_near);
    out->core[byte] = row_bits(is_near & (sums.nearest <= out->squared_spacing));
    out->negative[byte] = row_bits(is_near & (mean <= 0.0f));
}

#if LANES == 8
/* Points of some bricks, gathered. */
typedef struct {
    float x[GATHERED], y[GATHERED], z[GATHERED], nx[GATHERED], ny[GATHERED], nz[GATHERED];
} Gathered;

/* Add gathered points to all rows of a brick whose first node is `first`. */
static inline void add_gathered(
    const field_grid *g, const Gathered *points, const uint count, RowSums *rows, const float8 x, const int4 first)
{
    ushort chosen[GATHERED];
    float squares[GATHERED];
    for (int row = 0; row < BRICK_ROWS; ++row) {
        const float y = g->nodes.y + (float)(first.y + row % BRICK_WIDE) * g->nodes.w;
        const float z = g->nodes.z + (float)(first.z + row / BRICK_WIDE) * g->nodes.w;
        uint used = 0;
        for (uint point = 0; point < count; ++point) {
            const float dy = y - points->y[point], dz = z - points->z[point];
            const float square = dy * dy + dz * dz;
            chosen[used] = (ushort)point;
            squares[used] = square;
            used += square < g->squared_reach;
        }
        RowSums sums = rows[row];
        for (uint place = 0; place < used; ++place) {
            const uint point = chosen[place];
            const float height =
                (y - points->y[point]) * points->ny[point] + (z - points->z[point]) * points->nz[point];
            sums = add_point(sums, g, x, points->x[point], squares[place], points->nx[point], height);
        }
        rows[row] = sums;
    }
}

/* Measure all rows of a brick. */
#define ITEMS_OF_BRICK 1
static inline void measure_item(
    const field_grid *g, const field_rows *out, const uint place, const int4 brick, const uint item)
{
    const int4 first = brick * (int4)(BRICK_LONG, BRICK_WIDE, BRICK_WIDE, 0);
    const node_block block = find_block(g, first, BRICK_WIDE);
    const float3 low = block.low, high = block.high;
    const RowSums nothing = {(float8)(0.0f), (float8)(0.0f), (float8)(INFINITY)};
    RowSums sums[BRICK_ROWS];
    for (int row = 0; row < BRICK_ROWS; ++row)
        sums[row] = nothing;
    Gathered points;
    uint gathered = 0;
    for (int cell_z = block.over_z.x; cell_z <= block.over_z.y; ++cell_z)
        for (int cell_y = block.over_y.x; cell_y <= block.over_y.y; ++cell_y) {
            const uint2 range = points_over(g, block.over_x, cell_y, cell_z);
            for (uint point = range.x; point < range.y; ++point) {
                const float from_x = fmax(fmax(low.x - g->px[point], g->px[point] - high.x), 0.0f);
                const float from_y = fmax(fmax(low.y - g->py[point], g->py[point] - high.y), 0.0f);
                const float from_z = fmax(fmax(low.z - g->pz[point], g->pz[point] - high.z), 0.0f);
                points.x[gathered] = g->px[point];
                points.y[gathered] = g->py[point];
                points.z[gathered] = g->pz[point];
                points.nx[gathered] = g->nx[point];
                points.ny[gathered] = g->ny[point];
                points.nz[gathered] = g->nz[point];
                gathered += from_x * from_x + (from_y * from_y + from_z * from_z) < g->squared_reach;
                if (gathered == GATHERED) {
                    add_gathered(g, &points, gathered, sums, block.x, first);
                    gathered = 0;
                }
            }
        }
    add_gathered(g, &points, gathered, sums, block.x, first);
    for (uint row = 0; row < BRICK_ROWS; ++row)
        write_row(out, sums[row], place, brick, row);
}
#else
/* Measure row number `item` of a brick. */
#define ITEMS_OF_BRICK BRICK_ROWS
static inline void measure_item(
    const field_grid *g, const field_rows *out, const uint place, const int4 brick, const uint item)
{
    const int4 first = brick * (int4)(BRICK_LONG, BRICK_WIDE, BRICK_WIDE, 0)
                       + (int4)(0, (int)(item % BRICK_WIDE), (int)(item / BRICK_WIDE), 0);
    const node_block block = find_block(g, first, 1);
    RowSums sums = {(float8)(0.0f), (float8)(0.0f), (float8)(INFINITY)};
    for (int cell_z = block.over_z.x; cell_z <= block.over_z.y; ++cell_z)
        for (int cell_y = block.over_y.x; cell_y <= block.over_y.y; ++cell_y) {
            const uint2 range = points_over(g, block.over_x, cell_y, cell_z);
            for (uint point = range.x; point < range.y; ++point) {
                const float y = block.low.y - g->py[point], z = block.low.z - g->pz[point];
                const float square = y * y + z * z;
                if (square < g->squared_reach)
                    sums = add_point(
                        sums, g, block.x, g->px[point], square, g->nx[point], y * g->ny[point] + z * g->nz[point]);
            }
        }
    write_row(out, sums, place, brick, item);
}
#endif

/* Parameters  mask ranks starts x y z    in   the grid, see grid.h;  px py pz: its sorted coordinates
 *             nx ny nz       in   (n,) normals in the grid's order
 *             list           in   (count,) positions of bricks in the mask of bricks
 *             values         out  (count, 4, 4, 8) f in mm; 0 where no point has weight
 *             near core negative    out  (nodes_z, nodes_y, 4 * node_words) bytes of the masks; those of other bricks stay
 *             nodes origin within    as in merge_rows;  cells_x cells_y cells_z words: of the grid
 *             nodes_y        nodes along y;  node_words: words of a row of the masks;  bricks_y brick_words: of the bricks
 *             squared_reach squared_smoothing squared_bridge squared_spacing    R^2, s^2, B^2, h^2
 *             count          bricks
 * Launch      global = ITEMS_OF_BRICK * count rounded up by the host, any local
 * Guarantees  every value and every byte of the bricks is written */
__kernel void measure_nodes(
    __global const uint *restrict mask, __global const uint *restrict ranks, __global const uint *restrict starts,
    __global const float *restrict px, __global const float *restrict py, __global const float *restrict pz,
    __global const float *restrict nx, __global const float *restrict ny, __global const float *restrict nz,
    __global const uint *restrict list, __global float *restrict values, __global uchar *restrict near,
    __global uchar *restrict core, __global uchar *restrict negative, const float4 nodes, const float4 origin,
    const int cells_x, const int cells_y, const int cells_z, const int words, const float within, const uint nodes_y,
    const uint node_words, const uint bricks_y, const uint brick_words, const float squared_reach,
    const float squared_smoothing, const float squared_bridge, const float squared_spacing, const uint count)
{
    const field_grid grid = {mask, ranks, starts, px, py, pz, nx, ny, nz, nodes, origin, cells_x, cells_y, cells_z,
        words, within, squared_reach, 1.0f / squared_reach, squared_smoothing};
    const field_rows out = {values, near, core, negative, nodes_y, node_words, squared_bridge, squared_spacing};
    const uint place = (uint)get_global_id(0) / ITEMS_OF_BRICK, item = (uint)get_global_id(0) % ITEMS_OF_BRICK;
    if (place < count)
        measure_item(&grid, &out, place, brick_at(list[place], bricks_y, brick_words), item);
}

/* Parameters  inside  in   (rows, 4 * node_words) bytes: the node is inside; those of the slab
 *             volume  out  (rows, 8 * bricks_x) far_value inside, its negative elsewhere
 *             far_value    mm
 *             rows    rows of nodes of the slab;  bricks_x: bytes of a row with nodes;  node_words: words of a row
 *             row_offset   rows of nodes before the slab
 * Launch      global = rows * bricks_x rounded up by the host, any local
 * Guarantees  every node is written */
__kernel void fill_far(
    __global const uchar *restrict inside, __global float *restrict volume, const float far_value, const uint rows,
    const uint bricks_x, const uint node_words, const uint row_offset)
{
    const size_t item = get_global_id(0);
    const uint row = (uint)(item / bricks_x), brick = (uint)(item % bricks_x);
    if (row >= rows)
        return;
    const int bits = inside[(size_t)(row_offset + row) * (4 * node_words) + brick];
    const int8 is_inside = ((int8)(bits) & (int8)(1, 2, 4, 8, 16, 32, 64, 128)) != 0;
    vstore8(is_inside ? (float8)(far_value) : (float8)(-far_value), item, volume);
}

/* Parameters  list    in      (count,) positions of the bricks of the slab
 *             values  in      (count, 4, 4, 8) f
 *             near    in      (nodes_z, nodes_y, 4 * node_words) bytes, of all nodes; so is the next
 *             inside  in      nodes that are inside
 *             volume  in/out  (rows, 8 * bricks_x) the slab as filled; then |f|, at least `least` and at most far_value,
 *                             with the decided sign at near nodes
 *             row_offset      rows of nodes before the slab
 *             nodes_y node_words bricks_x bricks_y brick_words far_value    as before
 *             count           bricks
 * Launch      global = 16 * count rounded up by the host, any local */
__kernel void place_bricks(
    __global const uint *restrict list, __global const float *restrict values, __global const uchar *restrict near,
    __global const uchar *restrict inside, __global float *restrict volume, const uint row_offset, const uint nodes_y, const uint node_words, const uint bricks_x, const uint bricks_y,
    const uint brick_words, const float far_value, const float least, const uint count)
{
    const uint item = get_global_id(0);
    const uint place = item / BRICK_ROWS, row = item % BRICK_ROWS;
    if (place >= count)
        return;
    const int4 brick = brick_at(list[place], bricks_y, brick_words);
    const uint node_row = (uint)(brick.z * BRICK_WIDE + (int)(row / BRICK_WIDE)) * nodes_y
                          + (uint)(brick.y * BRICK_WIDE + (int)(row % BRICK_WIDE));
    const size_t byte = (size_t)node_row * (4 * node_words) + (size_t)brick.x;
    const int own = near[byte], bits = inside[byte];
    if (own == 0)
        return;
    const int8 numbers = (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    const float8 f = vload8(item, values);
    const float8 size = clamp(fabs(f), least, far_value);
    const float8 either = ((int8)(own) & numbers) != 0 ? size : (float8)(far_value);
    const float8 result = ((int8)(bits) & numbers) != 0 ? either : -either;
    vstore8(result, (size_t)(node_row - row_offset) * bricks_x + (size_t)brick.x, volume);
}

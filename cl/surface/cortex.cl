/* The outer surface of a wall of bone, read from the whole profile of HU across it.
 *
 *      HU  |          ______ cortex
 *          |        /        \                    along the outward normal at a vertex, three plateaus blurred by a
 *          |       |          |                   Gaussian of width s:
 *    inner |______/|          |\_____ outer           outer * O + cortex * (1 - O - I) + inner * I
 *          |       |          |                       O = Phi((x - x0) / s),  I = Phi((x0 - t - x) / s)
 *          +-------+----------+------> x, mm      The place x0 and the thickness t are searched; the three plateaus are
 *               x0 - t       x0                   linear and solved for at each x0 and t (variable projection).
 *
 * Values between voxels are linear ones, which blurs further, by more the farther they are from voxels: each sample has
 * its own variance, and the blur a third and a fourth cumulant (series of Gram and Charlier).
 *
 * Reference: Treece et al. 2010, "High resolution cortical bone thickness measurement from clinical CT data", Med. Image
 * Anal. 14, 276-290; Golub and Pereyra 1973 (variable projection, with the Jacobian of Kaufman 1975); Abramowitz and
 * Stegun 1964, 26.2.17 (Phi); Keys 1981 (cubic convolution).
 *
 * Passes
 *   1. sample_profiles   once for each part of the volume that the device holds;
 *                        with CUBIC values between slices are those of a cubic convolution of four of them, where their
 *                        gaps are alike within 1 %, else linear
 *   2. fit_profiles      all places of a piece; HU count in thousands inside, so that float32 keeps its digits */
#define TAKES_WIDE_LANES
#include "include/lanes.h"
#include "include/volume.h"

#define SAMPLES 13 /* of a profile */
#define CENTRE 7 /* the sample at the vertex: one more lies on the side of the bone */
#define RESULTS 9 /* numbers of a fit: x0, t, outer, cortex, inner, residual, variance of x0, peak, room */
#define ROUNDS 6 /* steps of Levenberg and Marquardt */
#define SLACK 1.0003f /* a step that costs so little more counts as one that helps: near the best place costs are rounding */
#define SHARPNESS -0.75f /* parameter of the cubic convolution between slices */
#define MEAN_SPREAD 0.16666667f /* of linear interpolation, in squares of the step between voxels */
#define LEAST_SPREAD 0.15f /* variance of a sample's blur, as a share of that of its profile */
#define FRAME 2 /* rows: square of the normal's part across the slices, square of the gap there */
#define ROWS 54 /* of a profile: its samples, its frame, and three by three what interpolation adds to their blur */

static inline floats between_lanes(const floats value, const floats low, const floats high)
{
    return lesser(greater(value, low), high);
}

/* Values between four voxels of a slice each, of which the first lie at these indices. */
static inline floats between_voxels(
    __global const VOXEL *voxels, const size_t *at, const int next, const int across, const floats fi, const floats fj)
{
    float a[LANES], b[LANES], c[LANES], d[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        __global const VOXEL *first = voxels + at[lane];
        a[lane] = (float)first[0], b[lane] = (float)first[next];
        c[lane] = (float)first[across], d[lane] = (float)first[across + next];
    }
    const floats low = load_lanes(a), high = load_lanes(c);
    const floats below = low + fi * (load_lanes(b) - low), above = high + fi * (load_lanes(d) - high);
    return below + fj * (above - below);
}

/* What interpolation adds to the blur: variance, a sixth of the third cumulant, a 24th of the fourth. */
typedef struct { floats second, third, fourth; } series;

/* Adds what linear interpolation at a share of the way between two voxels, which lie step mm apart along a profile, adds to
 * the blur there: variance is beyond the mean over all shares. */
static inline series add_series(const series before, const floats share, const floats step)
{
    const floats spread = share * (1.0f - share), square = step * step;
    const series sum = {before.second + square * (spread - MEAN_SPREAD),
        before.third + square * step * spread * (2.0f * share - 1.0f) * (1.0f / 6.0f),
        before.fourth + square * square * spread * (1.0f - 6.0f * spread) * (1.0f / 24.0f)};
    return sum;
}

/* Of LANES places the slices below and above: what x and y are counted from, heights, 1 / the height between them. */
typedef struct {
    float low_x[LANES], low_y[LANES], low_z[LANES], per_mm[LANES], up_x[LANES], up_y[LANES], up_z[LANES];
} slice_pairs;

/* Fills the pairs of these layers; returns 1 or -1 where the layer at a height lies beyond, in that direction. */
static inline ints look_up_slices(
    __global const float4 *slices, const int nk, const ints layers, const floats height, slice_pairs *pairs)
{
    int names[LANES];
    store_lanes(layers, names);
    for (int lane = 0; lane < LANES; ++lane) {
        const float4 below = slices[names[lane]], above = slices[min(names[lane] + 1, nk - 1)];
        pairs->low_x[lane] = below.x, pairs->low_y[lane] = below.y, pairs->low_z[lane] = below.z;
        pairs->up_x[lane] = above.x, pairs->up_y[lane] = above.y, pairs->up_z[lane] = above.z;
        pairs->per_mm[lane] = below.w;
    }
    return choose((layers < max(nk - 2, 0)) & (height >= load_lanes(pairs->up_z)), (ints)(1), (ints)(0))
        - choose((layers > 0) & (height < load_lanes(pairs->low_z)), (ints)(1), (ints)(0));
}

/* Parameters  voxels      in   the slices first_k and following of a volume of (nk, nj, ni)
 *             slices      in   (nk) x y: what i and j are counted from in the slice, in the steps of slice 0; z: its height,
 *                              mm; w: 1 / height to the next slice, 0 for the last
 *             places      in   (4, stride) i and j in slice 0, height in mm, number of the slice at or below
 *             directions  in   (3, stride) the first three per mm along the outward normal
 *             profiles    out  (ROWS, stride) HU at first_mm + n * step_mm, NaN beyond the volume; square of the normal's
 *                              part across the slices; square of the gap there, in units of usual_gap; and see series
 *             i_square j_square  squares of the steps between voxels in a slice, mm2
 *             known_k     1, or 0 where what interpolation between slices adds is its mean alone
 *             ni nj nk, first_k
 * Launch      global = count / LANES rounded up by the host, any local
 * Assumes     stride is a multiple of LANES, with a place in each column; all slices that a profile meets are there; with
 *             CUBIC one more on either side
 * Guarantees  every row of every place is written */
__kernel void sample_profiles(
    __global const VOXEL *restrict voxels, __global const float4 *restrict slices,
    __global const float *restrict places, __global const float *restrict directions,
    __global float *restrict profiles, const int ni, const int nj, const int nk, const int first_k,
    const float first_mm, const float step_mm, const float usual_gap, const float i_square, const float j_square,
    const float known_k, const uint stride, const uint count)
{
    const size_t item = LANES * get_global_id(0), row = stride, slice = (size_t)ni * (size_t)nj;
    if (item >= count)
        return;
    __global const float *place = places + item, *direction = directions + item;
    const floats start_x = load_lanes(place), start_y = load_lanes(place + row), start_z = load_lanes(place + 2 * row);
    const floats to_x = load_lanes(direction), to_y = load_lanes(direction + row), to_z = load_lanes(direction + 2 * row);
    __global float *profile = profiles + item;
    const floats along_i = i_square * to_x, along_j = j_square * to_y;
    const int last = max(nk - 2, 0), next = ni > 1, across = nj > 1 ? ni : 0;
    ints layers = to_ints(load_lanes(place + 3 * row));
    size_t at[LANES];
    slice_pairs between;
    look_up_slices(slices, nk, layers, start_z, &between);
    const floats gap = nk > 1 ? 1.0f / (load_lanes(between.per_mm) * usual_gap) : (floats)(1.0f);
    store_lanes(to_z * to_z, profile + SAMPLES * row);
    store_lanes(gap * gap, profile + (SAMPLES + 1) * row);
    for (int n = 0; n < SAMPLES; ++n) {
        const float away = first_mm + (float)n * step_mm;
        const floats x = start_x + away * to_x, y = start_y + away * to_y, z = start_z + away * to_z;
        /* Between even slices the layer is known at once; else it is looked for from there. */
        const floats steps = (z - load_lanes(between.low_z)) * load_lanes(between.per_mm);
        const ints guess = layers + to_ints(steps) - choose(steps < 0.0f, (ints)(1), (ints)(0));
        layers = lesser_int(greater_int(guess, (ints)(0)), (ints)(last));
        ints change = look_up_slices(slices, nk, layers, z, &between);
        while (ANY_LANE(change != 0)) {
            layers += change;
            change = look_up_slices(slices, nk, layers, z, &between);
        }
        const floats low_x = load_lanes(between.low_x), low_y = load_lanes(between.low_y);
        const floats low_z = load_lanes(between.low_z), per_mm = load_lanes(between.per_mm);
        const floats over_x = load_lanes(between.up_x) - low_x, over_y = load_lanes(between.up_y) - low_y;
        const floats over_z = load_lanes(between.up_z) - low_z;
        const floats part = (z - low_z) * per_mm;
        const floats i = x - (low_x + part * over_x), j = y - (low_y + part * over_y);
        const ints is_within = (i >= -0.5f) & (i <= (float)ni - 0.5f) & (j >= -0.5f) & (j <= (float)nj - 0.5f)
            & (part >= -0.5f) & (part <= 1.5f);
        const floats ci = between_lanes(i, (floats)(0.0f), (floats)((float)(ni - 1)));
        const floats cj = between_lanes(j, (floats)(0.0f), (floats)((float)(nj - 1)));
        const ints li = lesser_int(to_ints(ci), (ints)(max(ni - 2, 0))), lj = lesser_int(to_ints(cj), (ints)(max(nj - 2, 0)));
        const floats fi = ci - to_floats(li), fj = cj - to_floats(lj);
        const floats fk = between_lanes(part, (floats)(0.0f), (floats)(1.0f));
        int columns[LANES], lines[LANES], names[LANES];
        store_lanes(layers, names);
        store_lanes(li, columns);
        store_lanes(lj, lines);
        for (int lane = 0; lane < LANES; ++lane)
            at[lane] = voxel_index(columns[lane], lines[lane], names[lane] - first_k, ni, nj);
        const floats under = between_voxels(voxels, at, next, across, fi, fj);
        const floats over = between_voxels(voxels + (nk > 1 ? slice : 0), at, next, across, fi, fj);
        floats value = under + fk * (over - under);
#ifdef CUBIC
        int even[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const int layer = names[lane];
            const float own = between.per_mm[lane], least = 0.01f * own;
            even[lane] = layer > 0 && layer + 2 < nk && fabs(slices[layer - 1].w - own) <= least
                && fabs(slices[layer + 1].w - own) <= least;
            at[lane] -= even[lane] ? slice : 0;
        }
        floats cubic = (floats)(0.0f);
        for (int m = -1; m < 3; ++m) {
            const floats d = fabs(fk - (float)m);
            const floats near = ((SHARPNESS + 2.0f) * d - (SHARPNESS + 3.0f)) * d * d + 1.0f;
            const floats far = SHARPNESS * (((d - 5.0f) * d + 8.0f) * d - 4.0f);
            cubic += choose(d < 1.0f, near, far) * between_voxels(voxels, at, next, across, fi, fj);
            for (int lane = 0; lane < LANES; ++lane)
                at[lane] += even[lane] ? slice : 0;
        }
        value = choose(load_lanes(even) != 0, cubic, value);
#endif
        store_lanes(choose(is_within, value, (floats)(NAN)), profile + n * row);
        const floats along_k = known_k * (over_x * along_i + over_y * along_j + over_z * to_z);
        const series none = {(floats)(0.0f), (floats)(0.0f), (floats)(0.0f)};
        const series sum = add_series(add_series(add_series(none, fi, along_i), fj, along_j), fk, along_k);
        __global float *more = profile + (SAMPLES + FRAME + n) * row;
        store_lanes(sum.second, more);
        store_lanes(sum.third, more + SAMPLES * row);
        store_lanes(sum.fourth, more + 2 * SAMPLES * row);
    }
}

/* e^x for x <= 0, to 2e-7 of its value; 0 below -80. */
static inline floats exp_below_zero(const floats x)
{
    const floats twos = greater(x, (floats)(-80.0f)) * 1.44269504f;
    const ints whole = to_ints(twos - 0.5f); /* rounded towards zero: the nearest whole number */
    const floats f = (twos - to_floats(whole)) * 0.69314718f;
    const floats power
        = 1.0f + f * (1.0f + f * (0.5f + f * (0.16666667f + f * (0.041666668f + f * (0.0083333338f + f * 0.0013888889f)))));
    return choose(x > -80.0f, power * as_floats((whole + 127) << 23), (floats)(0.0f));
}

/* Phi(z), to 8e-8, and its derivative. */
static inline floats normal_share(const floats z, floats *density)
{
    const floats size = greater(z, -z), t = 1.0f / (1.0f + 0.2316419f * size);
    *density = 0.39894228f * exp_below_zero(-0.5f * z * z);
    const floats tail = *density * t
        * (0.31938153f + t * (-0.356563782f + t * (1.781477937f + t * (-1.821255978f + t * 1.330274429f))));
    return choose(z >= 0.0f, 1.0f - tail, tail);
}

/* Phi(z) where the blur has a third and a fourth cumulant (Gram and Charlier), and its derivative. */
static inline floats edge_share(const floats z, const floats third, const floats fourth, floats *density)
{
    floats normal;
    const floats share = normal_share(z, &normal), zz = z * z, cubic = z * (zz - 3.0f);
    *density = normal * (1.0f + third * cubic + fourth * (zz * (zz - 6.0f) + 3.0f));
    return share - normal * (third * (zz - 1.0f) + fourth * cubic);
}

/* The profiles of LANES places, the samples of each that count, and what is known before: means and precisions of the
 * plateaus, in thousands of HU and in units of the weight of a sample. */
typedef struct {
    __global const float *values, *weights;
    uint stride;
    ints low, high;
    floats blur;
    float first_mm, step_mm, cortex, inner, keep_outer, keep_cortex, keep_inner;
} wall_profiles;

/* A fit at x0 and t: the plateaus, the cost with what was known before, that of the samples alone, and the normal
 * equations of x0 and t with the plateaus projected out. */
typedef struct {
    floats x0, t, outer, cortex, inner, cost, samples, xx, xt, tt, to_x, to_t;
} wall_fit;

static inline __attribute__((always_inline)) wall_fit fit_plateaus(const wall_profiles *p, const floats x0, const floats t)
{
    floats oo = (floats)(p->keep_outer), kk = (floats)(p->keep_cortex), ii = (floats)(p->keep_inner);
    floats ok = (floats)(0.0f), oi = ok, ki = ok, yo = ok, yk = ok, yi = ok, yy = ok;
    floats pp = ok, pq = ok, qq = ok, po = ok, pk = ok, pi = ok, qo = ok, qk = ok, qi = ok, yp = ok, yq = ok;
    const floats square = p->blur * p->blur, least = LEAST_SPREAD * square;
    for (int n = 0; n < SAMPLES; ++n) {
        __global const float *of_sample = p->values + (size_t)n * p->stride;
        const floats given = load_lanes(of_sample);
        const ints counts = (p->low <= n) & (p->high >= n);
        const floats w = choose(counts, (floats)(p->weights[n]), (floats)(0.0f));
        const floats y = choose(counts, 0.001f * given - p->cortex, (floats)(0.0f));
        of_sample += (size_t)(SAMPLES + FRAME) * p->stride;
        const floats sharp = 1.0f / sqrt(greater(square + load_lanes(of_sample), least)), cube = sharp * sharp * sharp;
        const floats third = cube * load_lanes(of_sample + (size_t)SAMPLES * p->stride);
        const floats fourth = cube * sharp * load_lanes(of_sample + 2 * (size_t)SAMPLES * p->stride);
        const floats z = ((p->first_mm + (float)n * p->step_mm) - x0) * sharp;
        floats rise, fall;
        const floats o = edge_share(z, third, fourth, &rise), i = 1.0f - edge_share(z + t * sharp, third, fourth, &fall);
        const floats k = 1.0f - o - i;
        const floats a = rise * sharp, b = fall * sharp; /* derivatives of o and i by x0, but for the sign of a */
        const floats wo = w * o, wk = w * k, wi = w * i, wa = w * a, wb = w * b;
        oo += wo * o;
        kk += wk * k;
        ii += wi * i;
        ok += wo * k;
        oi += wo * i;
        ki += wk * i;
        yo += wo * y;
        yk += wk * y;
        yi += wi * y;
        yy += w * y * y;
        pp += wa * a;
        pq += wa * b;
        qq += wb * b;
        po += wa * o;
        pk += wa * k;
        pi += wa * i;
        qo += wb * o;
        qk += wb * k;
        qi += wb * i;
        yp += wa * y;
        yq += wb * y;
    }
    const floats known = p->keep_inner * (p->inner - p->cortex); /* the cortex is where HU are counted from */
    const floats to_i = yi + known;
    const floats c_oo = kk * ii - ki * ki, c_ok = oi * ki - ok * ii, c_oi = ok * ki - oi * kk;
    const floats c_kk = oo * ii - oi * oi, c_ki = oi * ok - oo * ki, c_ii = oo * kk - ok * ok;
    const floats scale = 1.0f / (oo * c_oo + ok * c_ok + oi * c_oi);
    const floats outer = scale * (c_oo * yo + c_ok * yk + c_oi * to_i);
    const floats cortex = scale * (c_ok * yo + c_kk * yk + c_ki * to_i);
    const floats inner = scale * (c_oi * yo + c_ki * yk + c_ii * to_i);
    /* By x0 the model changes by a (cortex - outer) - b (cortex - inner), by t by b (cortex - inner). */
    const floats u = cortex - outer, v = cortex - inner;
    const floats xo = u * po - v * qo, xk = u * pk - v * qk, xi = u * pi - v * qi;
    const floats to = v * qo, tk = v * qk, ti = v * qi;
    const floats gone_o = scale * (c_oo * xo + c_ok * xk + c_oi * xi), gone_k = scale * (c_ok * xo + c_kk * xk + c_ki * xi);
    const floats gone_i = scale * (c_oi * xo + c_ki * xk + c_ii * xi);
    const floats less_o = scale * (c_oo * to + c_ok * tk + c_oi * ti), less_k = scale * (c_ok * to + c_kk * tk + c_ki * ti);
    const floats less_i = scale * (c_oi * to + c_ki * tk + c_ii * ti);
    const floats left_p = yp - outer * po - cortex * pk - inner * pi, left_q = yq - outer * qo - cortex * qk - inner * qi;
    wall_fit f;
    f.x0 = x0;
    f.t = t;
    f.outer = outer;
    f.cortex = cortex;
    f.inner = inner;
    f.samples = yy - 2.0f * (outer * yo + cortex * yk + inner * yi)
        + outer * outer * (oo - p->keep_outer) + cortex * cortex * (kk - p->keep_cortex)
        + inner * inner * (ii - p->keep_inner) + 2.0f * (outer * cortex * ok + outer * inner * oi + cortex * inner * ki);
    const floats far = inner - (p->inner - p->cortex);
    f.cost = f.samples + p->keep_outer * outer * outer + p->keep_cortex * cortex * cortex + p->keep_inner * far * far;
    f.xx = u * u * pp - 2.0f * u * v * pq + v * v * qq - (xo * gone_o + xk * gone_k + xi * gone_i);
    f.xt = u * v * pq - v * v * qq - (xo * less_o + xk * less_k + xi * less_i);
    f.tt = v * v * qq - (to * less_o + tk * less_k + ti * less_i);
    f.to_x = u * left_p - v * left_q;
    f.to_t = v * left_q;
    return f;
}

static inline wall_fit choose_fit(const ints take, const wall_fit a, const wall_fit b)
{
    const wall_fit f = {choose(take, a.x0, b.x0), choose(take, a.t, b.t), choose(take, a.outer, b.outer),
        choose(take, a.cortex, b.cortex), choose(take, a.inner, b.inner), choose(take, a.cost, b.cost),
        choose(take, a.samples, b.samples), choose(take, a.xx, b.xx), choose(take, a.xt, b.xt),
        choose(take, a.tt, b.tt), choose(take, a.to_x, b.to_x), choose(take, a.to_t, b.to_t)};
    return f;
}

/* Samples of LANES profiles that belong to the wall: outwards up to the lowest value before HU rise by `rise` again,
 * inwards as far behind the wall; neither beyond a sample that is missing.  Also the highest of these values. */
static inline void find_wall(
    __global const float *values, const uint stride, const float rise, ints *low, ints *high, floats *peak)
{
    const floats centre = load_lanes(values + (size_t)CENTRE * stride);
    floats least = centre, most = centre;
    ints last = (ints)(CENTRE), lowest = last, ends = centre != centre;
    for (int n = CENTRE + 1; n < SAMPLES; ++n) {
        const floats y = load_lanes(values + (size_t)n * stride);
        const ints goes_on = ends == 0, missing = goes_on & (y != y), again = goes_on & (y > least + rise);
        last = choose(again, lowest, choose(goes_on & (missing == 0), (ints)(n), last));
        ends |= missing | again;
        const ints lower = (ends == 0) & (y < least);
        least = choose(lower, y, least);
        lowest = choose(lower, (ints)(n), lowest);
        most = choose((ends == 0) & (y > most), y, most);
    }
    ints first = (ints)(CENTRE), fell = (ints)(0);
    lowest = first;
    least = (floats)(MAXFLOAT);
    ends = centre != centre;
    for (int n = CENTRE - 1; n >= 0; --n) {
        const floats y = load_lanes(values + (size_t)n * stride);
        const ints goes_on = ends == 0, missing = goes_on & (y != y);
        fell |= goes_on & (y < most - rise);
        const ints again = goes_on & (fell != 0) & (y > least + rise);
        first = choose(again, lowest, choose(goes_on & (missing == 0), (ints)(n), first));
        ends |= missing | again;
        const ints lower = (ends == 0) & (fell != 0) & (y < least);
        least = choose(lower, y, least);
        lowest = choose(lower, (ints)(n), lowest);
        most = choose((ends == 0) & (y > most), y, most);
    }
    *low = first;
    *high = last;
    *peak = most;
}

/* Parameters  profiles    in   (ROWS, stride) see sample_profiles
 *             weights     in   (SAMPLES) of the samples
 *             fits        out  (RESULTS, stride) x0, t in mm; outer, cortex, inner, residual (root mean square) in HU;
 *                              variance of x0 in mm2, for samples with a variance of 1 HU2 each; highest value of the
 *                              wall in HU, NaN where the vertex lies beyond the volume; mm from the vertex to the last
 *                              sample outwards that belongs to the wall
 *             first_mm step_mm  place of sample n: first_mm + n * step_mm
 *             blur across       mm: width of the Gaussian within the slices, and across them at the usual gap
 *             cortex inner      HU that are expected
 *             keep_outer keep_cortex keep_inner  precision of outer around cortex, of cortex and of inner, in samples of
 *                              1000 HU
 *             rise        HU by which values rise where the next wall begins
 *             count
 * Launch      global = count / LANES rounded up by the host, any local
 * Assumes     stride is a multiple of LANES
 * Guarantees  all results of the places are written; x0 stays within the samples of its wall, t within 0.05
 *             of the blur and the length of the profile */
__kernel void fit_profiles(
    __global const float *restrict profiles, __global const float *restrict weights, __global float *restrict fits,
    const float first_mm, const float step_mm, const float blur, const float across, const float cortex,
    const float inner, const float keep_outer, const float keep_cortex, const float keep_inner, const float rise,
    const uint stride, const uint count)
{
    const size_t item = LANES * get_global_id(0);
    if (item >= count)
        return;
    const floats steep = load_lanes(profiles + item + (size_t)SAMPLES * stride);
    const floats gap = load_lanes(profiles + item + (size_t)(SAMPLES + 1) * stride);
    const floats over = greater(blur * blur + (across * across - blur * blur) * gap, (floats)(0.1f * blur * blur));
    const floats width = sqrt(blur * blur * (1.0f - steep) + over * steep);
    wall_profiles p = {profiles + item, weights, stride, (ints)(0), (ints)(0), width, first_mm, step_mm,
        0.001f * cortex, 0.001f * inner, keep_outer, keep_cortex, keep_inner};
    floats peak;
    find_wall(p.values, stride, rise, &p.low, &p.high, &peak);
    const floats nearest = first_mm + step_mm * to_floats(p.low), room = first_mm + step_mm * to_floats(p.high);
    const floats thinnest = (floats)(0.05f * width), thickest = (floats)(step_mm * (float)SAMPLES);
    const float ease_x = 2.5e-13f * cortex * cortex / (step_mm * step_mm), ease_t = 30.0f * ease_x;
    /* The best of a thin, a usual and a thick wall is where the search begins. */
    wall_fit now = fit_plateaus(&p, between_lanes(-1.1f * width, nearest, room), 0.9f * width);
    for (int start = 1; start < 3; ++start) {
        const floats x0 = between_lanes(-0.8f * width, nearest, room);
        const wall_fit other = fit_plateaus(&p, x0, (start == 1 ? 2.2f : 5.0f) * width);
        now = choose_fit(other.cost < now.cost, other, now);
    }
    floats damping = (floats)(0.01f);
    for (int round = 0; round < ROUNDS; ++round) {
        const floats xx = now.xx * (1.0f + damping) + ease_x, tt = now.tt * (1.0f + damping) + ease_t;
        const floats scale = 1.0f / (xx * tt - now.xt * now.xt);
        const floats to_x = between_lanes(scale * (tt * now.to_x - now.xt * now.to_t), -width, width);
        const floats to_t = between_lanes(scale * (xx * now.to_t - now.xt * now.to_x), -1.5f * width, 1.5f * width);
        const floats new_t = greater(now.t + to_t, 0.5f * now.t);
        const wall_fit next = fit_plateaus(
            &p, between_lanes(now.x0 + to_x, nearest, room), between_lanes(new_t, thinnest, thickest));
        const ints better = next.cost < SLACK * now.cost;
        now = choose_fit(better, next, now);
        damping *= choose(better, (floats)(0.2f), (floats)(5.0f));
    }
    floats total = (floats)(1e-6f);
    for (int n = 0; n < SAMPLES; ++n)
        total += choose((p.low <= n) & (p.high >= n), (floats)(weights[n]), (floats)(0.0f));
    /* Rounding leaves less than nothing of a wall that has hardly any thickness. */
    const floats tt = greater(now.tt, (floats)(0.0f)) + ease_t, xx = greater(now.xx, (floats)(0.0f)) + ease_x;
    const floats scale = 1e-6f / greater(xx * tt - now.xt * now.xt, 1e-6f * xx * tt);
    __global float *fit = fits + item;
    store_lanes(now.x0, fit);
    store_lanes(now.t, fit + stride);
    store_lanes(1000.0f * now.outer + cortex, fit + 2 * (size_t)stride);
    store_lanes(1000.0f * now.cortex + cortex, fit + 3 * (size_t)stride);
    store_lanes(1000.0f * now.inner + cortex, fit + 4 * (size_t)stride);
    store_lanes(1000.0f * sqrt(greater(now.samples, (floats)(0.0f)) / total), fit + 5 * (size_t)stride);
    store_lanes(scale * tt, fit + 6 * (size_t)stride);
    store_lanes(peak, fit + 7 * (size_t)stride);
    store_lanes(room, fit + 8 * (size_t)stride);
}

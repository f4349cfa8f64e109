/* The signs of all nodes of a field: see field.cl.  The field itself is known near points alone, and near its ends it is not
 * to be trusted.
 *
 *      + + o o o o + +      o: near nodes, within B of a point, with the sign of the field; bits of `negative`
 *      + o o * * o o +      *: core, within one spacing: their sign stays
 *      o * * . . * * o      + .: far nodes.  Runs of them along x that touch are a region; each pair of a near and a far
 *      o o . . . . o o      neighbour is a vote with the sign of the near one, and a region takes that of most votes
 *
 * Where a hole in the cloud is wider than 2 B, inner and outer nodes are one region, and the votes are split.
 *
 * A near node outside of the core is not to be trusted either: there the planes of points behind a sheet of bone, or beside
 * an edge, reach too far.  The signs of far nodes flood these nodes, one neighbour farther each pass, and stop at the core.
 * Where both signs arrive at once, and where none does, a node keeps the sign of the field.
 *
 * Passes
 *   1. count_runs, list_runs      runs of far nodes (scans between: scan.cl)
 *   2. count_joins, list_joins    pairs of runs that touch in y or z (then their components: union_find.cl)
 *   3. count_votes                votes for each run (the host adds them by region)
 *   4. paint_regions              inside: the sign of the field near points, of the region elsewhere
 *   5. flood_signs                one neighbour farther, as often as the host says
 *
 * Masks are words of 32 nodes along x, `words` a row, bit b of word w is node 32 w + b; rows count y first, then z.  Races:
 * each item writes words of its own; flood_signs reads one pair of buffers and writes another. */

/* Bits of a word that are nodes. */
static inline uint node_bits(const int word, const int nx)
{
    const int left = nx - 32 * word;
    return left >= 32 ? 0xffffffffu : (1u << left) - 1;
}

/* Bits `first` to `last` of a word, of a run from node `first` to node `last`. */
static inline uint run_bits(const int word, const int first, const int last)
{
    uint bits = 0xffffffffu;
    if (word == first >> 5)
        bits &= 0xffffffffu << (first & 31);
    if (word == last >> 5)
        bits &= 0xffffffffu >> (31 - (last & 31));
    return bits;
}

/* Parameters  near    in   (rows, words)
 *             counts  out  (rows,) runs of far nodes in each row
 *             nx words rows    nodes and words of a row, rows
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_runs(
    __global const uint *restrict near, __global uint *restrict counts, const int nx, const int words, const uint rows)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    uint count = 0, before = 0;
    for (int word = 0; word < words; ++word) {
        const uint far = ~near[(size_t)row * (size_t)words + (size_t)word] & node_bits(word, nx);
        count += popcount(far & ~(far << 1 | before));
        before = far >> 31;
    }
    counts[row] = count;
}

/* Parameters  near     in   (rows, words)
 *             offsets  in   (rows,) runs before each row
 *             firsts lasts    out  (runs,) first and last node of each run along x
 *             nx words rows    as in count_runs
 * Launch      as count_runs */
__kernel void list_runs(
    __global const uint *restrict near, __global const uint *restrict offsets, __global int *restrict firsts,
    __global int *restrict lasts, const int nx, const int words, const uint rows)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    uint begun = offsets[row], ended = begun, before = 0;
    for (int word = 0; word < words; ++word) {
        const uint far = ~near[(size_t)row * (size_t)words + (size_t)word] & node_bits(word, nx);
        const uint shifted = far << 1 | before;
        for (uint bits = far & ~shifted; bits != 0; bits &= bits - 1)
            firsts[begun++] = 32 * word + (int)popcount((bits & -bits) - 1);
        for (uint bits = shifted & ~far; bits != 0; bits &= bits - 1)
            lasts[ended++] = 32 * word + (int)popcount((bits & -bits) - 1) - 1;
        before = far >> 31;
    }
    if (ended < begun)
        lasts[ended] = nx - 1;
}

/* Count the pairs of touching runs of two rows, and list them as triangles (a, b, b) where there is room for them. */
static inline uint join_rows(
    __global const int *firsts, __global const int *lasts, uint a, const uint end_a, uint b, const uint end_b,
    __global uint *pairs, const uint first_pair)
{
    uint count = 0;
    while (a < end_a && b < end_b) {
        const int last_a = lasts[a], last_b = lasts[b];
        if (firsts[a] <= last_b && firsts[b] <= last_a) {
            if (pairs != 0)
                vstore3((uint3)(a, b, b), first_pair + count, pairs);
            ++count;
        }
        if (last_a < last_b)
            ++a;
        else
            ++b;
    }
    return count;
}

/* Join the runs of a row to those of the next row in y and in z. */
static inline uint join_row(
    __global const uint *offsets, __global const int *firsts, __global const int *lasts, const uint row, const uint ny,
    const uint rows, const uint runs, __global uint *pairs, const uint first_pair)
{
    const uint begin = offsets[row], end = row + 1 < rows ? offsets[row + 1] : runs;
    uint count = 0;
    if (row % ny + 1 < ny)
        count = join_rows(
            firsts, lasts, begin, end, end, row + 2 < rows ? offsets[row + 2] : runs, pairs, first_pair);
    if (row + ny < rows)
        count += join_rows(
            firsts, lasts, begin, end, offsets[row + ny], row + ny + 1 < rows ? offsets[row + ny + 1] : runs, pairs,
            first_pair + count);
    return count;
}

/* Parameters  offsets       in   (rows,) runs before each row
 *             firsts lasts  in   (runs,)
 *             counts        out  (rows,) pairs of runs of the row with those of the next rows in y and z
 *             ny rows runs  rows along y, all rows, all runs
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every count is written */
__kernel void count_joins(
    __global const uint *restrict offsets, __global const int *restrict firsts, __global const int *restrict lasts,
    __global uint *restrict counts, const uint ny, const uint rows, const uint runs)
{
    const uint row = get_global_id(0);
    if (row < rows)
        counts[row] = join_row(offsets, firsts, lasts, row, ny, rows, runs, 0, 0);
}

/* Parameters  offsets       in   (rows,)
 *             firsts lasts  in   (runs,)
 *             places        in   (rows,) pairs before each row
 *             pairs         out  (joins, 3) the two runs, the second one twice: a triangle of union_find.cl
 *             ny rows runs  as in count_joins
 * Launch      as count_joins */
__kernel void list_joins(
    __global const uint *restrict offsets, __global const int *restrict firsts, __global const int *restrict lasts,
    __global const uint *restrict places, __global uint *restrict pairs, const uint ny, const uint rows, const uint runs)
{
    const uint row = get_global_id(0);
    if (row < rows)
        join_row(offsets, firsts, lasts, row, ny, rows, runs, pairs, places[row]);
}

/* Votes of the near nodes of a row beside nodes `first` to `last` of another: .x for outside, .y for inside. */
static inline uint2 votes_beside(
    __global const uint *near, __global const uint *negative, const uint row, const int words, const int first,
    const int last)
{
    uint2 votes = (uint2)(0, 0);
    for (int word = first >> 5; word <= last >> 5; ++word) {
        const size_t at = (size_t)row * (size_t)words + (size_t)word;
        const uint voters = near[at] & run_bits(word, first, last);
        if (voters != 0)
            votes += (uint2)(popcount(voters & ~negative[at]), popcount(voters & negative[at]));
    }
    return votes;
}

/* The vote of the near node at an end of a run. */
static inline uint2 vote_of(
    __global const uint *negative, const uint row, const int words, const int node)
{
    const uint inside = negative[(size_t)row * (size_t)words + (size_t)(node >> 5)] >> (node & 31) & 1;
    return (uint2)(1 - inside, inside);
}

/* Parameters  near negative    in   (rows, words)
 *             offsets          in   (rows,);  firsts lasts: (runs,)
 *             votes            out  (runs, 2) votes for outside and for inside
 *             nx words ny rows runs    nodes and words of a row, rows along y, all rows, all runs
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  the votes of every run are written */
__kernel void count_votes(
    __global const uint *restrict near, __global const uint *restrict negative, __global const uint *restrict offsets,
    __global const int *restrict firsts, __global const int *restrict lasts, __global uint *restrict votes, const int nx,
    const int words, const uint ny, const uint rows, const uint runs)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const uint end = row + 1 < rows ? offsets[row + 1] : runs, y = row % ny;
    for (uint run = offsets[row]; run < end; ++run) {
        const int first = firsts[run], last = lasts[run];
        uint2 sum = (uint2)(0, 0);
        if (y > 0)
            sum += votes_beside(near, negative, row - 1, words, first, last);
        if (y + 1 < ny)
            sum += votes_beside(near, negative, row + 1, words, first, last);
        if (row >= ny)
            sum += votes_beside(near, negative, row - ny, words, first, last);
        if (row + ny < rows)
            sum += votes_beside(near, negative, row + ny, words, first, last);
        if (first > 0)
            sum += vote_of(negative, row, words, first - 1);
        if (last + 1 < nx)
            sum += vote_of(negative, row, words, last + 1);
        vstore2(sum, run, votes);
    }
}

/* Parameters  near      in      (rows, words)
 *             negative  in/out  (rows, words); then as `inside`
 *             offsets   in      (rows,);  firsts lasts: (runs,);  signs: (runs,) 1 where the run's region is inside, else 0
 *             inside    out     (rows, words) near nodes by `negative`, far ones by their region
 *             reached   out     (rows, words) far nodes
 *             also_reached    out     the same
 *             nx words rows runs    nodes and words of a row, rows, runs
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void paint_regions(
    __global const uint *restrict near, __global uint *restrict negative, __global const uint *restrict offsets,
    __global const int *restrict firsts, __global const int *restrict lasts, __global const uchar *restrict signs,
    __global uint *restrict inside, __global uint *restrict reached, __global uint *restrict also_reached,
    const int nx, const int words, const uint rows, const uint runs)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const size_t begin = (size_t)row * (size_t)words;
    const uint end = row + 1 < rows ? offsets[row + 1] : runs;
    for (uint run = offsets[row]; run < end; ++run)
        if (signs[run])
            for (int word = firsts[run] >> 5; word <= lasts[run] >> 5; ++word)
                negative[begin + (size_t)word] |= run_bits(word, firsts[run], lasts[run]);
    for (int word = 0; word < words; ++word) {
        const size_t at = begin + (size_t)word;
        const uint far = ~near[at] & node_bits(word, nx);
        inside[at] = negative[at];
        reached[at] = far;
        also_reached[at] = far;
    }
}

/* Signs that arrive at the nodes of a word: .x from outside, .y from inside. */
static inline uint2 arrive(const uint2 before, const uint reached, const uint inside)
{
    return before | (uint2)(reached & ~inside, reached & inside);
}

/* Parameters  near core      in   (rows, words)
 *             inside         in   (rows, words)
 *             reached        in   (rows, words) far nodes, and those that their signs have reached
 *             next_inside    out  (rows, words) the same, one neighbour farther; words without near nodes outside of the
 *             next_reached   out  core stay as they are
 *             words ny rows    words of a row, rows along y, all rows
 * Launch      global = rows * words rounded up by the host, any local */
__kernel void flood_signs(
    __global const uint *restrict near, __global const uint *restrict core, __global const uint *restrict inside,
    __global const uint *restrict reached, __global uint *restrict next_inside, __global uint *restrict next_reached,
    const uint words, const uint ny, const uint rows)
{
    const size_t at = get_global_id(0);
    const uint row = (uint)(at / words), word = (uint)(at % words);
    if (row >= rows)
        return;
    const uint others = near[at] & ~core[at];
    if (others == 0)
        return;
    const uint old = reached[at], own = inside[at];
    uint taken = own, now = old;
    if (others & ~old) {
        const uint y = row % ny;
        const size_t layer = (size_t)ny * words;
        uint2 signs = arrive((uint2)(0, 0), old << 1, own << 1);
        signs = arrive(signs, old >> 1, own >> 1);
        if (word > 0)
            signs = arrive(signs, reached[at - 1] >> 31, inside[at - 1] >> 31);
        if (word + 1 < words)
            signs = arrive(signs, reached[at + 1] << 31, inside[at + 1] << 31);
        if (y > 0)
            signs = arrive(signs, reached[at - words], inside[at - words]);
        if (y + 1 < ny)
            signs = arrive(signs, reached[at + words], inside[at + words]);
        if (row >= ny)
            signs = arrive(signs, reached[at - layer], inside[at - layer]);
        if (row + ny < rows)
            signs = arrive(signs, reached[at + layer], inside[at + layer]);
        const uint found = (signs.x | signs.y) & others & ~old, one_sign = found & (signs.x ^ signs.y);
        taken = (own & ~one_sign) | (signs.y & one_sign);
        now = old | found;
    }
    next_inside[at] = taken;
    next_reached[at] = now;
}

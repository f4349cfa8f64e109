/* Pieces of a row of a bit mask, held in registers: 16 words on CPUs, 4 on GPUs, a word of halo at either end.
 *
 * A row that fits into a piece has no halo; else a piece begins a word before its own words and ends a word behind them:
 *
 *      words of the row   0 1 2 ... 13 | 14 15 ... 27 | ...
 *      piece 0          h o o o ...  o   h
 *      piece 1                       h   o  o ...   o   h */
#ifndef CLRECON_ROW_PIECES_H
#define CLRECON_ROW_PIECES_H

#include "include/lanes.h"

#define CPU_PIECE_WORDS 16
#define GPU_PIECE_WORDS 4

#if LANES == 8
#define PIECE_WORDS CPU_PIECE_WORDS
typedef uint8 words_of_piece;
typedef int8 places_of_piece;
#define VECTOR_WORDS 8
#define WORD_NUMBERS ((int8)(0, 1, 2, 3, 4, 5, 6, 7))
#define LOAD_VECTOR(at) vload8(0, at)
#define as_words as_uint8
#else
#define PIECE_WORDS GPU_PIECE_WORDS
typedef uint4 words_of_piece;
typedef int4 places_of_piece;
#define VECTOR_WORDS 4
#define WORD_NUMBERS ((int4)(0, 1, 2, 3))
#define LOAD_VECTOR(at) vload4(0, at)
#define as_words as_uint4
#endif

/* The words of a piece: first half and second half, or all of them. */
typedef struct {
    words_of_piece a;
#if LANES == 8
    words_of_piece b;
#endif
} row_piece;

/* A word of the mask, 0 beyond its ends. */
static inline uint word_at(__global const uint *mask, const int at, const int total)
{
    return at >= 0 && at < total ? mask[at] : 0;
}

/* Words from `at` on; zeros beyond the ends of the mask of `total` words.  Part of the kernels by order: PoCL 3.0 would
 * make a call of it, which takes as long as the rest of a ball. */
static inline __attribute__((always_inline)) words_of_piece load_vector(__global const uint *mask, const int at, const int total)
{
    if (at >= 0 && at + VECTOR_WORDS <= total)
        return LOAD_VECTOR(mask + at);
#define AT(n) word_at(mask, at + n, total)
#if LANES == 8
    return (uint8)(AT(0), AT(1), AT(2), AT(3), AT(4), AT(5), AT(6), AT(7));
#else
    return (uint4)(AT(0), AT(1), AT(2), AT(3));
#endif
#undef AT
}

/* Bits that belong to a row of ni voxels, of its words from `first` on, which may lie before or behind it. */
static inline words_of_piece bits_of_row(const int first, const int ni)
{
    const places_of_piece word = WORD_NUMBERS + first, left = ni - 32 * word;
    const words_of_piece some = ((words_of_piece)(1u) << as_words(left & 31)) - 1u;
    const words_of_piece within = left >= 32 ? (words_of_piece)(~0u) : left > 0 ? some : (words_of_piece)(0u);
    return word >= 0 ? within : (words_of_piece)(0u);
}

/* Words of a row from `at` on, their bits `shift` voxels further along i, `beyond` beyond the row. */
static inline words_of_piece load_row_shifted(
    __global const uint *mask, const int at, const int first, const int shift, const int ni, const int total,
    const uint flip, const uint beyond)
{
    const int word = shift >> 5, bits = shift & 31;
    const words_of_piece own = bits_of_row(first + word, ni);
    const words_of_piece low = ((load_vector(mask, at + word, total) ^ flip) & own) | (beyond & ~own);
    if (bits == 0)
        return low;
    const words_of_piece next = bits_of_row(first + word + 1, ni);
    const words_of_piece high = ((load_vector(mask, at + word + 1, total) ^ flip) & next) | (beyond & ~next);
    return low >> (uint)bits | high << (uint)(32 - bits);
}

/* Store four words of a piece, from its word n on, where they are some of those to be stored. */
#define STORE_WORD(n, word) \
    if (first + (n) >= begin && first + (n) < end) \
        to[first + (n)] = word;
#define STORE_WORDS(words, n) \
    STORE_WORD(n, (words).x) STORE_WORD(n + 1, (words).y) STORE_WORD(n + 2, (words).z) STORE_WORD(n + 3, (words).w)

/* For pieces of each kind:
 *
 *      bits_of_piece    the bits that belong to a row of ni voxels, from its word `first` on
 *      within_row       the same words with `beyond` in place of what is not in the row
 *      join_word        set the bits of a word in all words
 *      join_piece       set those of the words of a mask from `at` on, or with `flip` ~0 the others
 *      join_shifted     set those that load_row_shifted has
 *      widen            set bits and their neighbours on both sides; before the first and behind the last word lies
 *                       `beyond`
 *      store_piece      what is in the row, or with `flip` ~0 the complement, as words begin to end - 1 of the row */
#if LANES == 8
static inline row_piece bits_of_piece(const int first, const int ni)
{
    const row_piece piece = {bits_of_row(first, ni), bits_of_row(first + VECTOR_WORDS, ni)};
    return piece;
}

static inline row_piece within_row(row_piece piece, const row_piece row, const uint beyond)
{
    piece.a = (piece.a & row.a) | (beyond & ~row.a);
    piece.b = (piece.b & row.b) | (beyond & ~row.b);
    return piece;
}

static inline void join_word(row_piece *piece, const uint word)
{
    piece->a |= word;
    piece->b |= word;
}

static inline void join_piece(
    row_piece *piece, __global const uint *mask, const int at, const int total, const uint flip)
{
    piece->a |= load_vector(mask, at, total) ^ flip;
    piece->b |= load_vector(mask, at + VECTOR_WORDS, total) ^ flip;
}

static inline void join_shifted(
    row_piece *piece, __global const uint *mask, const int at, const int first, const int shift, const int ni,
    const int total, const uint flip, const uint beyond)
{
    const int next = VECTOR_WORDS;
    piece->a |= load_row_shifted(mask, at, first, shift, ni, total, flip, beyond);
    piece->b |= load_row_shifted(mask, at + next, first + next, shift, ni, total, flip, beyond);
}

static inline row_piece widen(row_piece piece, const uint beyond)
{
    const words_of_piece a = piece.a, b = piece.b;
    const uint8 before_a = (uint8)(beyond, a.s0123, a.s456), after_a = (uint8)(a.s1234, a.s567, b.s0);
    const uint8 before_b = (uint8)(a.s7, b.s0123, b.s456), after_b = (uint8)(b.s1234, b.s567, beyond);
    piece.a = a | a << 1 | before_a >> 31 | a >> 1 | after_a << 31;
    piece.b = b | b << 1 | before_b >> 31 | b >> 1 | after_b << 31;
    return piece;
}

static inline void store_piece(
    const row_piece piece, const row_piece row, __global uint *to, const int first, const int begin, const int end,
    const uint flip)
{
    const words_of_piece a = (piece.a ^ flip) & row.a, b = (piece.b ^ flip) & row.b;
    if (first == begin && end == PIECE_WORDS) {
        vstore8(a, 0, to);
        vstore8(b, 1, to);
        return;
    }
    STORE_WORDS(a.lo, 0)
    STORE_WORDS(a.hi, 4)
    STORE_WORDS(b.lo, 8)
    STORE_WORDS(b.hi, 12)
}
#else
static inline row_piece bits_of_piece(const int first, const int ni)
{
    const row_piece piece = {bits_of_row(first, ni)};
    return piece;
}

static inline row_piece within_row(row_piece piece, const row_piece row, const uint beyond)
{
    piece.a = (piece.a & row.a) | (beyond & ~row.a);
    return piece;
}

static inline void join_word(row_piece *piece, const uint word) { piece->a |= word; }

static inline void join_piece(
    row_piece *piece, __global const uint *mask, const int at, const int total, const uint flip)
{
    piece->a |= load_vector(mask, at, total) ^ flip;
}

static inline void join_shifted(
    row_piece *piece, __global const uint *mask, const int at, const int first, const int shift, const int ni,
    const int total, const uint flip, const uint beyond)
{
    piece->a |= load_row_shifted(mask, at, first, shift, ni, total, flip, beyond);
}

static inline row_piece widen(row_piece piece, const uint beyond)
{
    const words_of_piece a = piece.a, before = (uint4)(beyond, a.xyz), after = (uint4)(a.yzw, beyond);
    piece.a = a | a << 1 | before >> 31 | a >> 1 | after << 31;
    return piece;
}

static inline void store_piece(
    const row_piece piece, const row_piece row, __global uint *to, const int first, const int begin, const int end,
    const uint flip)
{
    const words_of_piece a = (piece.a ^ flip) & row.a;
    STORE_WORDS(a, 0)
}
#endif

#endif

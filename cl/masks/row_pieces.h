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

/* The same words with `beyond` in place of what is not in the row. */
static inline row_piece within_row(row_piece piece, const row_piece row, const uint beyond)
{
    piece.a = (piece.a & row.a) | (beyond & ~row.a);
#if LANES == 8
    piece.b = (piece.b & row.b) | (beyond & ~row.b);
#endif
    return piece;
}

/* Set bits and their neighbours on both sides; before the first and behind the last word are words of `beyond`. */
static inline row_piece widen(row_piece piece, const uint beyond)
{
    const words_of_piece a = piece.a;
#if LANES == 8
    const words_of_piece b = piece.b;
    const uint8 before_a = (uint8)(beyond, a.s0123, a.s456), after_a = (uint8)(a.s1234, a.s567, b.s0);
    const uint8 before_b = (uint8)(a.s7, b.s0123, b.s456), after_b = (uint8)(b.s1234, b.s567, beyond);
    piece.a = a | a << 1 | before_a >> 31 | a >> 1 | after_a << 31;
    piece.b = b | b << 1 | before_b >> 31 | b >> 1 | after_b << 31;
#else
    const uint4 before = (uint4)(beyond, a.xyz), after = (uint4)(a.yzw, beyond);
    piece.a = a | a << 1 | before >> 31 | a >> 1 | after << 31;
#endif
    return piece;
}

#endif

/* Jitter: the place of a pixel's samples in their segments, for rays whose samples must not line up.
 *
 * The mixer is lowbias32 (C. Wellons 2018, "Prospecting for hash functions"), applied to y, then to x with the result;
 * clrecon/proof/rays/render.py gives the same bits. */
#ifndef CLRECON_JITTER_H
#define CLRECON_JITTER_H

static inline uint mix_bits(uint bits)
{
    bits = (bits ^ bits >> 16) * 0x7feb352du;
    bits = (bits ^ bits >> 15) * 0x846ca68bu;
    return bits ^ bits >> 16;
}

static inline uint hash_pixel(const uint x, const uint y)
{
    return mix_bits(x + mix_bits(y + 0x9e3779b9u));
}

/* 0 to below 1, of 24 bits: exact in float32. */
static inline float jitter_pixel(const uint x, const uint y)
{
    return (float)(hash_pixel(x, y) >> 8) * 0x1p-24f;
}

#endif

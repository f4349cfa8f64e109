/* The weights of an occupancy: two rounds of [1 2 1] / 4 along each axis, in whole numbers. */
#ifndef CLRECON_LABEL_MASKS_H
#define CLRECON_LABEL_MASKS_H

#define REACH 2 /* samples each way that count for a sample's occupancy */
#define FINENESS 4 /* stored occupancies are FINENESS times the sum of weights, which is 16 * 16 * 16 */

/* 6, 4, 1 at distance 0, 1, 2. */
static inline int weigh(int offset)
{
    return offset == 0 ? 6 : offset * offset == 1 ? 4 : 1;
}

#endif

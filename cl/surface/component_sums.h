/* Sums over the components of runs of cells: places in `sums`. */
#ifndef CLRECON_COMPONENT_SUMS_H
#define CLRECON_COMPONENT_SUMS_H

/* Of numbers of cells, which may be large, the lower 32 bits come first. */
#define COMPONENTS 0
#define CHOSEN 1
#define ACTIVE_CELLS 2
#define CHOSEN_CELLS 4
#define LARGEST 6
#define LARGEST_LEFT_OUT 7
#define SUMS 8

#endif

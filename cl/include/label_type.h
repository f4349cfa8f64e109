/* The element type of label maps on a device: LABEL is uchar or ushort (-D LABEL=uchar). */
#ifndef CLRECON_LABEL_TYPE_H
#define CLRECON_LABEL_TYPE_H

#ifndef LABEL
#define LABEL ushort
#endif

#endif

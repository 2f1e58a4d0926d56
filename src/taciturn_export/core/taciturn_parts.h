/* taciturn: functions that the files of the core share. Not for programs. */
#ifndef TACITURN_PARTS_H
#define TACITURN_PARTS_H

#include "taciturn.h"

#define tac_count_ticks TAC_SIZED(tac_count_ticks)
#define tac_degrade TAC_SIZED(tac_degrade)
#define tac_tell TAC_SIZED(tac_tell)
#define tac_put TAC_SIZED(tac_put)
#define tac_get TAC_SIZED(tac_get)
#define tac_checksum TAC_SIZED(tac_checksum)
#define tac_bits TAC_SIZED(tac_bits)
#define tac_fits TAC_SIZED(tac_fits)
#define tac_is_nan TAC_SIZED(tac_is_nan)
#define tac_collect TAC_SIZED(tac_collect)
#define tac_foresee TAC_SIZED(tac_foresee)
#define tac_write_tag TAC_SIZED(tac_write_tag)
#define tac_forget_numbered TAC_SIZED(tac_forget_numbered)
#define tac_report TAC_SIZED(tac_report)
#define tac_draw TAC_SIZED(tac_draw)
#define tac_is_admitted TAC_SIZED(tac_is_admitted)
#define tac_take_proof TAC_SIZED(tac_take_proof)
#define tac_send_proof TAC_SIZED(tac_send_proof)
#define tac_set_point_count TAC_SIZED(tac_set_point_count)
#define tac_set_points TAC_SIZED(tac_set_points)
#define tac_talks TAC_SIZED(tac_talks)
#define tac_operator TAC_SIZED(tac_operator)

#ifdef __cplusplus
extern "C" {
#endif

#if TAC_FLOAT32
typedef uint32_t tac_word; /* the bits of a number */
#define TAC_EXPONENT UINT32_C(0x7F800000)
#else
typedef uint64_t tac_word;
#define TAC_EXPONENT UINT64_C(0x7FF0000000000000)
#endif

/* Write the last `bytes` bytes of a value, big-endian. */
void tac_put(uint8_t *to, uint64_t value, unsigned bytes);

/* Read a value of `bytes` bytes, big-endian. */
uint64_t tac_get(const uint8_t *from, unsigned bytes);

/* Return the CRC-32 of a content that continues a content with the CRC `before`; 0: there is none before. */
uint32_t tac_checksum(uint32_t before, const uint8_t *content, size_t size);

/* Write the tag of at least one byte of content: keyed BLAKE2s of 16 bytes with the personalization "taciturn". */
void tac_write_tag(tac_key key, const uint8_t *content, size_t size, uint8_t *tag);

/* Return 64 bits of the keyed hash of a content, which nobody without the key can predict. */
uint64_t tac_draw(tac_key key, const uint8_t *content, size_t size);

/* Drop the early packets of a sender that has started again, also of all kinds that it numbers together: they are older
 * than all that it sends now. */
void tac_forget_numbered(tac_node *node, unsigned i);

/* Let the node report to an operator. */
void tac_report(tac_node *node);

/* Return whether the sender of a packet of channel `i` has proven that it is running; if not, challenge it. */
bool tac_is_admitted(tac_node *node, unsigned i, const tac_packet *packet);

/* Handle a challenge or an answer. */
void tac_take_proof(tac_node *node, const tac_packet *packet);

/* Write the next datagram of the proofs: a challenge, an answer, or a packet sent again; return its size, or 0. */
size_t tac_send_proof(tac_node *node, uint8_t *datagram);

/* Return whether a node sends packets on a link: data along it, or (with `back`) acknowledgements against it. */
bool tac_talks(const tac_node_data *data, uint8_t link, bool back);

/* Write the acknowledgement at a place of channel `i`: of which step, and on a late link after how many pieces. */
void tac_tell(const tac_node *node, unsigned i, unsigned place, tac_packet *packet);

/* Return the number of the channel on which a node is given set-points, or the number of channels if there is none. */
unsigned tac_set_points(const tac_node_data *data);

/* Return the number of the channel of an operator, or the number of channels if there is none. */
unsigned tac_operator(const tac_node_data *data);

/* Return the number of set-points that a node is given. */
uint8_t tac_set_point_count(const tac_node_data *data);

/* Return whether all payloads carry the numbers: none is larger than FLT_MAX, or no number. */
bool tac_fits(const tac_real *numbers, unsigned count);

/* Return whether a number is NaN, from its bits without the sign, whatever the compiler assumes of numbers. */
bool tac_is_nan(tac_real value);

/* Return the bits of a number. */
tac_word tac_bits(tac_real value);

/* Return the number of steps that have begun. */
uint64_t tac_count_ticks(const tac_node *node);

/* Record an event that violates an assumption of the theory, after `ticks` steps have begun. */
void tac_degrade(tac_node *node, uint64_t ticks);

/* Copy the packet of channel `i` that a step reads to the inputs, and acknowledge the packet if it arrived in time. */
void tac_collect(tac_node *node, unsigned i, uint64_t tick);

/* Do the same before the step, with the packets that have arrived so far, which wait further. */
void tac_foresee(tac_node *node, unsigned i, uint64_t tick);

#ifdef __cplusplus
}
#endif

#endif

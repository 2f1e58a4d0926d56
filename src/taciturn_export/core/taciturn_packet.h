/* taciturn: packets, and their encoding as datagrams. taciturn.h includes this file. */
#ifndef TACITURN_PACKET_H
#define TACITURN_PACKET_H

#include <float.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "taciturn_config.h" /* generated: TAC_FLOAT32, TAC_LINKS, TAC_VALUES, TAC_DATAGRAM, TAC_WAITING, TAC_SIZED */

#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 16 /* 16: only _Float16 differs */
#error "numbers are computed in more digits than they have; expected -msse2 -mfpmath=sse, or -ffloat-store's like"
#endif

#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__) || \
    defined(__NO_SIGNED_ZEROS__)
#error "numbers are rounded as the compiler likes; expected no -ffast-math, and none of its parts"
#endif

/* Every operation is rounded once. With FMA contraction, results would not be bit-identical to the design. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif

/* The linker names of all functions contain the sizes, so that files compiled with different sizes do not link. */
#define tac_encode TAC_SIZED(tac_encode)
#define tac_decode TAC_SIZED(tac_decode)
#define tac_is_back TAC_SIZED(tac_is_back)

#ifdef __cplusplus
extern "C" {
#endif

#if TAC_FLOAT32
typedef float tac_real;
#else
typedef double tac_real;
#endif

enum { TAC_DATA, TAC_ACKNOWLEDGEMENT, TAC_MARK, TAC_MEASUREMENT, TAC_INPUT, TAC_CHALLENGE, TAC_ANSWER, TAC_SETPOINT,
       TAC_REPORT, TAC_MANUAL, TAC_MODE };
enum { TAC_SENSOR_LINK, TAC_ACTUATOR_LINK, TAC_PLANT_LINK };                          /* links of three nodes */
enum { TAC_ENCODED_FLOAT64, TAC_ENCODED_FLOAT32, TAC_ENCODED_INT16 };                 /* payloads */
typedef enum { TAC_OK, TAC_MALFORMED, TAC_CORRUPTED, TAC_FOREIGN, TAC_FORGED } tac_verdict;

/* A packet, with `entries` values. */
typedef struct {
  uint64_t tick;
  uint64_t nonce; /* random number of a challenge, which its answer repeats */
  uint32_t sequence;
  uint32_t epoch;
  uint16_t loop;
  uint8_t kind;
  uint8_t link;
  uint8_t entries;
  bool back; /* whether a mark, a challenge or an answer travels against the link; other kinds have one direction */
  tac_real values[TAC_VALUES];
} tac_packet; /* an operator gives a controller set-points as TAC_SETPOINT and manual inputs as TAC_MANUAL, which tells
               * him the set-points in effect as TAC_REPORT and the manual inputs as TAC_MODE */

/* The payload format of packets of one kind on one link. With int16, a value is an integer multiple of a step size:
 * `per_unit` and `per_step` contain steps per unit and units per step of each entry. Otherwise they are NULL. */
typedef struct {
  uint8_t kind;
  uint8_t link;
  uint8_t encoding;
  uint8_t entries;
  const tac_real *per_unit;
  const tac_real *per_step;
  bool samples; /* whether NaN stands for an entry that is missing: the measurements of a plant */
} tac_shape;

/* The packet formats of a policy. */
typedef struct {
  uint64_t fingerprint;
  const tac_shape *shapes;
  uint8_t shape_count;
} tac_wire;

/* The secret that authenticates packets: 16 to 32 bytes, or NULL for none. With a key of another size, no packet is
 * sent or accepted. */
typedef struct {
  const uint8_t *bytes;
  uint8_t size;
} tac_key;

/* Encode a packet as a datagram of at most TAC_DATAGRAM bytes, and return its size. Return 0 if the policy has no such
 * packet, or if a value exceeds FLT_MAX, the largest number of all payloads, or is NaN but no missing sample. */
size_t tac_encode(const tac_wire *wire, tac_key key, const tac_packet *packet, uint8_t *datagram);

/* Decode a datagram. If the result is not TAC_OK, it is the reason for the rejection, and `packet` is not valid. */
tac_verdict tac_decode(const tac_wire *wire, tac_key key, const uint8_t *datagram, size_t size, tac_packet *packet);

/* Return whether a datagram that `tac_send` wrote goes back to the sender of the packets of its link. */
bool tac_is_back(const uint8_t *datagram);

#ifdef __cplusplus
}
#endif

#endif

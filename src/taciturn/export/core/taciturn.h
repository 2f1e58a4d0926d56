/* taciturn: nodes of an event-triggered control loop on a device: packets in, packets and the input of a plant out.
 *
 * Nothing is allocated, and no library of mathematics is needed. What a node computes in a tick, and the data of its
 * policy, are generated in files of their own; this core is the same for all of them. A node has no socket and no
 * clock: whoever calls it has. In each tick:
 *
 *     while (a datagram has come) tac_receive(node, datagram, size);
 *     tac_step(node, tick, measurement, NULL);
 *     while ((size = tac_send(node, datagram)) > 0) hand it on;
 *     if (tac_input(node) != NULL) apply it;
 *
 * Two policies on one device share this core, compiled with the larger sizes of their two taciturn_config.h.
 */
#ifndef TACITURN_H
#define TACITURN_H

#include <float.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "taciturn_config.h" /* generated: TAC_FLOAT32, TAC_VALUES, TAC_DATAGRAM, TAC_WAITING, TAC_SIZED */

#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 16 /* 16: _Float16 is one of its own */
#error "numbers are computed in more digits than they have; expected -msse2 -mfpmath=sse, or -ffloat-store's like"
#endif

#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(__RECIPROCAL_MATH__) || \
    defined(__NO_SIGNED_ZEROS__)
#error "numbers are rounded as the compiler likes; expected no -ffast-math, and none of its parts"
#endif

/* Every operation rounds once: nothing may be fused, or the bits are not those of the design. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif

/* The linker knows every function by a name with the sizes in it: files that were compiled with others do not link. */
#define tac_encode TAC_SIZED(tac_encode)
#define tac_decode TAC_SIZED(tac_decode)
#define tac_start TAC_SIZED(tac_start)
#define tac_watch TAC_SIZED(tac_watch)
#define tac_receive TAC_SIZED(tac_receive)
#define tac_step TAC_SIZED(tac_step)
#define tac_heard TAC_SIZED(tac_heard)
#define tac_send TAC_SIZED(tac_send)
#define tac_input TAC_SIZED(tac_input)
#define tac_degraded TAC_SIZED(tac_degraded)

#ifdef __cplusplus
extern "C" {
#endif

#if TAC_FLOAT32
typedef float tac_real;
#else
typedef double tac_real;
#endif

enum { TAC_DATA, TAC_ACKNOWLEDGEMENT, TAC_MARK, TAC_MEASUREMENT, TAC_INPUT };         /* kinds of packets */
enum { TAC_SENSOR_LINK, TAC_ACTUATOR_LINK, TAC_PLANT_LINK };                          /* links */
enum { TAC_ENCODED_FLOAT64, TAC_ENCODED_FLOAT32, TAC_ENCODED_INT16 };                 /* payloads */
typedef enum { TAC_OK, TAC_MALFORMED, TAC_CORRUPTED, TAC_FOREIGN, TAC_FORGED } tac_verdict;

/* One packet; of its values there are `entries`. */
typedef struct {
  uint64_t tick;
  uint32_t sequence;
  uint32_t epoch;
  uint16_t loop;
  uint8_t kind;
  uint8_t link;
  uint8_t entries;
  tac_real values[TAC_VALUES];
} tac_packet;

/* What a packet of a kind on a link holds. With int16, a value is a whole number of steps: steps per unit, and units
 * per step, of each entry; else NULL. */
typedef struct {
  uint8_t kind;
  uint8_t link;
  uint8_t encoding;
  uint8_t entries;
  const tac_real *per_unit;
  const tac_real *per_step;
} tac_shape;

/* The packets of a policy. */
typedef struct {
  uint64_t fingerprint;
  const tac_shape *shapes;
  uint8_t shape_count;
} tac_wire;

/* The secret that authenticates packets: 16 to 32 bytes; NULL: none. With one of another size none is sent or taken. */
typedef struct {
  const uint8_t *bytes;
  uint8_t size;
} tac_key;

/* Write a packet as a datagram of at most TAC_DATAGRAM bytes, and return its size; 0: the policy has no such packet, or
 * it holds what is no finite number. */
size_t tac_encode(const tac_wire *wire, tac_key key, const tac_packet *packet, uint8_t *datagram);

/* Read a datagram, or tell why it is no packet; then the packet is not to be used. */
tac_verdict tac_decode(const tac_wire *wire, tac_key key, const uint8_t *datagram, size_t size, tac_packet *packet);

/* Packets of a kind on a link that reach a node: which tick's it wants (`lag` ticks before), which part of a tick reads
 * them, and where their values stand among the inputs of the tick: first whether one has come. */
typedef struct {
  uint8_t kind;
  uint8_t link;
  uint8_t lag;
  uint8_t part;
  uint8_t entries;
  bool acknowledged; /* whether the node tells the sender what has come */
  uint16_t at;
} tac_channel_data;

enum { TAC_SENDS = 2 }; /* packets that a node sends in a tick, at most: there are as many links between nodes */

/* A packet that the node sends: where the decision stands among the outputs of a tick; the payload stands behind it. */
typedef struct {
  uint8_t link;
  uint8_t entries;
  uint16_t at;
} tac_send_data;

/* A clock: location after location; whole rounds of `period` ticks change nothing once it repeats. */
typedef struct {
  const uint16_t *following;
  uint16_t size;
  uint16_t period;
  uint16_t initial;
} tac_clock_data;

/* What a node is; generated. */
typedef struct {
  tac_wire wire;
  const tac_channel_data *channels;
  const tac_send_data *sends;
  const tac_clock_data *clocks;
  void (*first)(const tac_real *inputs, tac_real *memory, tac_real *outputs);
  void (*second)(const tac_real *inputs, tac_real *memory, tac_real *outputs); /* NULL: none */
  void (*draw)(uint64_t *generator, tac_real *drawn);                          /* NULL: nothing is drawn */
  const tac_real *start;      /* first values of the memory */
  uint64_t generator[4];      /* of the draws */
  uint32_t remembers;         /* ticks after which a fault is forgotten; UINT32_MAX: never */
  uint16_t input_count;       /* of a tick */
  uint16_t memory_count;
  uint16_t output_count;
  uint16_t clocks_at;         /* among the inputs of a tick */
  uint16_t drawn_at;
  uint16_t drawn_count;
  int16_t applied;            /* where the plant's input stands among the outputs; -1: the node has none */
  uint8_t measurement_count;  /* of the plant, the first inputs of a tick; 0: the node does not measure */
  uint8_t applied_count;
  uint8_t channel_count;
  uint8_t send_count;
  uint8_t clock_count;
  bool lossless;              /* whether every packet is to arrive */
} tac_node_data;

/* Which sequence numbers of a sender have come: the newest, and the 64 up to it. */
typedef struct {
  uint64_t seen;
  uint32_t epoch;
  uint32_t newest;
  uint32_t distinct;
  bool begun;
} tac_window;

typedef struct {
  tac_window window;
  tac_window marks;
  tac_packet waiting[TAC_WAITING];
  bool waits[TAC_WAITING];
  tac_packet behind; /* the newest that came too late */
  bool has_behind;
  uint32_t missing;
  uint64_t told; /* tick of the packet that is to be acknowledged */
  bool tells;
  uint32_t told_sequence; /* of the next acknowledgement */
} tac_channel;

/* What a node has met: counts of packets, as the host's nodes count them, and of what its theory does not know; they
 * begin anew after 2^32 - 1. A packet that a tick wants more than TAC_WAITING ticks after the last is `ahead`, and
 * dropped; of two that meet in one place before the first tick the newer waits, and the other is `late`. */
typedef struct {
  uint32_t received, used, late, ahead, duplicate, replayed, misdirected, superseded, marks; /* packets */
  uint32_t malformed, corrupted, foreign, forged;                                            /* datagrams */
  uint32_t unsent;           /* packets that were to hold what is no finite number */
  uint32_t missed, repeated; /* ticks */
} tac_counters;

typedef struct {
  const tac_node_data *data;
  tac_channel *channels;
  tac_real *inputs;
  tac_real *memory;
  tac_real *outputs;
  tac_real *input;         /* of the plant, as it was applied last */
  uint32_t *sequences;     /* of the next packet of each send */
  uint16_t *places;        /* of the clocks */
  uint64_t generator[4];
  tac_key key;
  const tac_real *safe_input; /* of the watchdog; NULL: the last input is held */
  uint32_t watchdog;          /* ticks; 0: there is none */
  uint64_t tick;           /* the last one */
  uint64_t heard;          /* one more than the tick in which something was heard last; 0: never */
  uint64_t newest;         /* one more than the tick of the newest packet that has come; 0: none has */
  uint64_t degraded_until; /* the node is degraded while fewer ticks than these have begun; UINT64_MAX: for ever */
  tac_counters counters;
  uint32_t epoch;
  uint16_t loop;
  tac_packet sending[TAC_SENDS]; /* the newest packet of each send */
  uint8_t pending;               /* bit i: that of send i is to be handed out */
  bool begun;
} tac_node;

/* Begin before the first tick. `epoch` is to grow with each start of a device that has forgotten all, as the seconds of
 * a clock do. The pointers of the node are set already (the generated function that calls this sets them). */
void tac_start(tac_node *node, uint32_t epoch, uint16_t loop, tac_key key);

/* Make the input of the plant safe when no packet has come for so many ticks: `safe_input` from then on, NULL: the last
 * one. 0 ticks: never, as after tac_start. For a node that has the actuator and that packets reach. */
void tac_watch(tac_node *node, uint32_t ticks, const tac_real *safe_input);

/* Take a datagram that has come; false: it was refused, or is not new. */
bool tac_receive(tac_node *node, const uint8_t *datagram, size_t size);

/* Go through a tick, less than UINT64_MAX. `measurement` is the plant's, where the node measures; `drawn` replaces the
 * node's own draws, NULL: it draws. A tick that is not later than the last is not gone through again; ticks that were
 * left out are made up for. false: the tick is not gone through, since it is not later or a measurement is no finite
 * number. */
bool tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn);

/* Return one more than the tick of the newest packet that has come; 0: none has. A node that starts while the loop runs
 * begins in the tick before that one, so that all count alike. */
uint64_t tac_heard(const tac_node *node);

/* Return the size of the next datagram to be sent, written to at most TAC_DATAGRAM bytes; 0: there is none. Of ticks
 * that were made up for, each link has its newest packet alone. */
size_t tac_send(tac_node *node, uint8_t *datagram);

/* Return the input of the plant: NULL where the node has none. */
const tac_real *tac_input(const tac_node *node);

/* Whether something has happened that the theory of the policy does not know, and is not forgotten yet; also where a
 * number has left its range: then the last input is held, and the node is to be started again. */
bool tac_degraded(const tac_node *node);

#ifdef __cplusplus
}
#endif

#endif

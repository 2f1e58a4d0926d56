/* taciturn: nodes of an event-triggered control loop on a device. They receive packets, and return packets and inputs.
 *
 * The core allocates no memory and needs no mathematical library. It is the same for all policies. The computations of
 * a node in a step, and the data of its policy, are generated as separate files. A node uses no sockets and no timers;
 * the calling program provides them. In each step, the program runs:
 *
 *     while (a datagram was received) tac_receive(node, datagram, size);
 *     tac_step(node, tick, measurement, NULL);
 *     while ((size = tac_send(node, datagram)) > 0) send the datagram;
 *     if (tac_input(node) != NULL) apply the input;
 *
 * An actuator on a link that delays packets at random can apply a packet within a step: see tac_act.
 *
 * Two policies on one device share this core; compile it with the larger sizes of their two taciturn_config.h.
 */
#ifndef TACITURN_H
#define TACITURN_H

#include "taciturn_packet.h"

#define tac_check TAC_SIZED(tac_check)
#define tac_start TAC_SIZED(tac_start)
#define tac_watch TAC_SIZED(tac_watch)
#define tac_mark_after TAC_SIZED(tac_mark_after)
#define tac_receive TAC_SIZED(tac_receive)
#define tac_receive_in TAC_SIZED(tac_receive_in)
#define tac_act TAC_SIZED(tac_act)
#define tac_set_keys TAC_SIZED(tac_set_keys)
#define tac_setpoint TAC_SIZED(tac_setpoint)
#define tac_setpoints TAC_SIZED(tac_setpoints)
#define tac_manual TAC_SIZED(tac_manual)
#define tac_is_manual TAC_SIZED(tac_is_manual)
#define tac_step TAC_SIZED(tac_step)
#define tac_ready TAC_SIZED(tac_ready)
#define tac_heard TAC_SIZED(tac_heard)
#define tac_send TAC_SIZED(tac_send)
#define tac_input TAC_SIZED(tac_input)
#define tac_behind TAC_SIZED(tac_behind)
#define tac_silent TAC_SIZED(tac_silent)
#define tac_silent_on TAC_SIZED(tac_silent_on)
#define tac_expire TAC_SIZED(tac_expire)
#define tac_save TAC_SIZED(tac_save)
#define tac_restore TAC_SIZED(tac_restore)
#define tac_degraded TAC_SIZED(tac_degraded)
#define tac_clock_start TAC_SIZED(tac_clock_start)
#define tac_clock_hear TAC_SIZED(tac_clock_hear)
#define tac_clock_receive TAC_SIZED(tac_clock_receive)
#define tac_clock_due TAC_SIZED(tac_clock_due)
#define tac_clock_offset TAC_SIZED(tac_clock_offset)
#define tac_clock_drift TAC_SIZED(tac_clock_drift)

#ifndef TAC_CATCH_UP
#define TAC_CATCH_UP 16 /* largest number of missed steps that one call of tac_step executes */
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Packets of one kind on one link that a node receives. Part `part` of a step reads the packet of the step `lag` steps
 * earlier. Input `at` of the step is whether a packet arrived, and the following inputs are its values. A link that is
 * with `pieces` delays packets at random: a step reads the newest packet that has arrived since the last step, unless
 * it has read a newer one. If a step has several pieces, these inputs are repeated for each piece, with the newest
 * packet that has arrived before the piece ends. A node that uses all packets has these inputs for each packet's age,
 * from 0 on. Acknowledgements tell after how many pieces a packet arrived. Then there is an input for each age: the
 * piece of the step in which the packet arrived, and TAC_NEVER if in none. */
typedef struct {
  uint8_t kind;
  uint8_t link;
  uint8_t lag;
  uint8_t part;
  uint8_t entries;
  bool acknowledged; /* whether the node acknowledges received packets */
  uint16_t at;
  uint32_t interval; /* largest number of steps between two packets of the sender; 0: not known */
  uint8_t pieces; /* of a step, if the link delays packets at random; otherwise 0 */
  uint8_t ages; /* of late acknowledgements, and of packets that are all used: number of ages; otherwise 0 */
} tac_channel_data;

#define TAC_NEVER 1000000
#define TAC_NO_MARKS UINT32_MAX
#define TAC_FORMAT 6U /* version of the generated data and of saved states */

/* A packet that the node sends: output `at` of a step is the decision, and the following outputs are the payload. */
typedef struct {
  uint8_t link;
  uint8_t entries;
  uint16_t at;
} tac_send_data;

/* A counter of the policy: the successor of each value. After `size` steps it is periodic with `period` steps. */
typedef struct {
  const uint16_t *following;
  uint16_t size;
  uint16_t period;
  uint16_t initial;
} tac_clock_data;

/* A part of the step of a node. */
typedef void tac_part(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs);

/* The data of a node; generated. */
typedef struct {
  uint32_t format; /* TAC_FORMAT of the program that generated the data */
  uint32_t crc;    /* CRC-32 of all data below and of the arrays to which they point; the code is not included */
  tac_wire wire;
  const tac_channel_data *channels;
  const tac_send_data *sends;
  const tac_clock_data *clocks;
  tac_part *first;
  tac_part *second;                                   /* NULL: no second part */
  void (*draw)(uint64_t *generator, tac_real *drawn); /* NULL: no random draws */
  const tac_real *constants;  /* numbers that the parts of a step read */
  const tac_real *start;      /* start values of the memory, then the set-points at the start */
  uint64_t generator[4];      /* state of the random number generator */
  uint32_t constant_count;
  uint32_t remembers;         /* steps after which an event has no effect; UINT32_MAX: never */
  uint16_t input_count;       /* number of inputs of a step */
  uint16_t memory_count;
  uint16_t output_count;
  uint16_t clocks_at;         /* index of the counters among the inputs of a step */
  uint16_t drawn_at;
  uint16_t drawn_count;
  uint16_t manual;            /* index of 1 or 0, before the manual inputs, among the inputs; 0: always automatic */
  int16_t applied;            /* index of the plant input among the outputs; -1: no actuator */
  int16_t limited;            /* index of the set-points in effect among the outputs; -1: they are not limited */
  uint8_t measurement_count;  /* first inputs of a step, then as many that are 1, or 0 if missing; 0: no sensor */
  uint8_t applied_count;
  uint8_t channel_count;
  uint8_t send_count;
  uint8_t clock_count;
  uint8_t manual_count;       /* inputs of the plant */
  bool lossless;              /* whether the theory assumes that every packet arrives */
} tac_node_data;

/* The received sequence numbers of a sender: the newest, and a bit for each of the 64 up to the newest. */
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
  uint8_t piece[TAC_WAITING]; /* of the next step in which each of them has arrived */
  bool tells_early[TAC_WAITING]; /* whether each of them is acknowledged before its step */
  tac_packet behind; /* the newest late packet */
  bool has_behind;
  uint64_t newest; /* step of the newest packet that a step has read, plus one; 0: none */
  uint64_t heard;  /* of data: number of the last step with a packet or a mark, plus one; 0: none */
  uint64_t marked; /* newest step that the sender has finished, plus one; 0: none */
  uint32_t missing;
  uint64_t told[TAC_WAITING]; /* steps of the packets to acknowledge, from the last place to the first */
  uint16_t after[TAC_WAITING]; /* number of pieces of a step after which each was read */
  uint8_t tells;              /* number of packets to acknowledge */
  uint32_t told_sequence; /* sequence number of the next acknowledgement */
  uint64_t first;         /* with a key: first step whose packets are valid */
  uint32_t proven;        /* epoch that the sender has proven */
  bool has_proof;
  bool challenged;        /* whether a challenge is open: its number is `challenges` of the node */
  bool challenges;        /* whether a challenge is to be sent */
  uint32_t challenge;     /* number of the open challenge */
} tac_channel;

/* The proof on a link that this node is running: an answer, and its last packets again. */
typedef struct {
  uint64_t nonce;
  uint64_t repeated; /* number of the last step in which packets were sent again, plus one; 0: none */
  bool answers;      /* whether an answer is to be sent */
  uint8_t again;     /* kinds of packets to be sent again */
} tac_proof;

/* The marks that a node sends on a link. They report that the node is running and has finished a step. */
typedef struct {
  uint64_t sent;     /* number of the last step with a packet on the link, plus one; 0: none */
  uint64_t marked;   /* number of the last step with a mark, plus one; 0: none */
  uint32_t sequence; /* sequence number of the next mark */
} tac_marks;

/* The counters of a node, which restart at 0 after 2^32 - 1. They are the same as those of nodes in Python, except that
 * the buffer is smaller: a packet that is read more than TAC_WAITING steps after the last step is dropped as `ahead`,
 * and of two packets at one place of the buffer before the first step, the older packet is `late`. */
typedef struct {
  uint32_t received, used, late, ahead, duplicate, replayed, misdirected, superseded, marks; /* packets */
  uint32_t malformed, corrupted, foreign, forged, unproven;                                  /* datagrams */
  uint32_t proofs;           /* challenges and answers */
  uint32_t unsent;           /* packets not sent because a value is not finite */
  uint32_t missed, repeated; /* steps */
  uint32_t missing;          /* steps in which an entry of the measurement was missing */
  uint32_t overflowed;       /* steps whose results are too large, so that the memory has started again */
  uint32_t overruled;        /* packets with set-points that are not those of the operator */
} tac_counters;

typedef struct {
  const tac_node_data *data;
  tac_channel *channels;
  tac_real *inputs;
  tac_real *memory;
  tac_real *outputs;
  tac_real *input;         /* last plant input, that of each piece of a step one after the other */
  tac_real *spare;         /* room for a copy of the memory; NULL: the node acts only when a step begins */
  uint32_t *sequences;     /* sequence number of the next packet of each send */
  uint16_t *places;        /* values of the counters of the policy */
  uint64_t generator[4];
  tac_key keys[TAC_LINKS][2]; /* by link: the key in use, and a further key that is accepted */
  const tac_real *safe_input; /* input after the watchdog expires; NULL: the last input */
  uint32_t watchdog;          /* time-out of the watchdog in steps; 0: no watchdog */
  uint64_t tick;           /* last step */
  uint64_t newest;         /* step number in the newest received packet, plus one; 0: none */
  uint64_t degraded_until; /* the node is degraded while fewer steps have begun; UINT64_MAX: forever */
  tac_counters counters;
  uint32_t epoch;
  uint32_t mark_after; /* steps without a packet on a link after which a mark is sent; 0: in every step */
  tac_marks marks[TAC_LINKS]; /* by link */
  tac_proof proofs[TAC_LINKS];
  uint32_t challenges; /* challenges so far, from which the nonces are computed */
  uint16_t loop;
  tac_packet sending[TAC_LINKS]; /* the newest packet of each send */
  uint32_t pending;              /* bit i: the packet of send i is not sent yet */
  uint64_t dated; /* step number in the newest received data or mark, plus one, for a clock */
  bool begun;
  bool unheard; /* whether tac_expire was called after the last packet */
  bool asked;   /* whether an operator has sent a packet since the last step */
  bool reports; /* whether a report to the operator is to be sent */
  bool modes;   /* whether he is to be told the mode of operation */
} tac_node;

/* Return whether the data of a node have the format of this core, and their CRC is correct. The generated function that
 * starts a node calls it; a program may repeat it. It covers all constants of the policy but 0 and 1, and no code. */
bool tac_check(const tac_node_data *data);

/* Initialize a node before its first step. Without a key, `epoch` must increase with each start of a device without its
 * memory; Unix time in seconds is suitable. With a key, `epoch` must differ at each start, and may be random. `key` is
 * that of all links. The generated function that calls this function sets the pointers of the node. */
void tac_start(tac_node *node, uint32_t epoch, uint16_t loop, tac_key key);

/* Set the key of a link by its number (of three nodes: TAC_SENSOR_LINK or TAC_ACTUATOR_LINK), also while the node runs:
 * `key` authenticates the packets that the node sends, and packets with `key` or `other` are accepted. To change a key
 * without a stop, let all nodes accept the new key first, then use it, then accept it alone. `other` may be {NULL, 0}.
 * Return false, without effect, if no node receives or sends on a link with this number. */
bool tac_set_keys(tac_node *node, uint8_t link, tac_key key, tac_key other);

/* Set the watchdog of every link on which the node receives data: after `ticks` steps without data or a mark on it, or
 * after the largest interval that the policy states for a link without losses, if this is shorter, the link is silent
 * and the node is degraded. If all links are silent, the input is `safe_input`, with as many numbers as that of
 * `tac_input`, or the last input if NULL. With 0 steps, as after tac_start, there is no watchdog. Set-points are not
 * watched: their sender need not run. */
void tac_watch(tac_node *node, uint32_t ticks, const tac_real *safe_input);

/* Return whether the watchdogs of all links have expired. The result stays true until a packet is accepted. */
bool tac_silent(const tac_node *node);

/* Return whether the watchdog of a link has expired, by the number of the link. */
bool tac_silent_on(const tac_node *node, uint8_t link);

/* Let the watchdog expire: for a program that executes no steps, because no packet has told the time yet or because the
 * device was stopped, and whose timer shows that no packet was accepted for the time-out of the watchdog. The node is
 * silent and degraded, and `tac_input` returns the safe input, until a packet is accepted. */
void tac_expire(tac_node *node);

/* Set the marks: after `ticks` steps without a packet on a link, `tac_send` returns a mark, so that the watchdog of the
 * receiver does not expire while the policy is silent. With 0, it returns a mark after every step, also next to data,
 * as nodes in virtual time require. With TAC_NO_MARKS, as after tac_start, it returns no marks. */
void tac_mark_after(tac_node *node, uint32_t ticks);

/* Process a received datagram. Return false if it is rejected, or its packet is not new. */
bool tac_receive(tac_node *node, const uint8_t *datagram, size_t size);

/* Process a datagram that has arrived in a piece of the step after the last one, from 0 on. The constants NODE_PIECES
 * and NODE_CUTS in the header of a node are the number of pieces, and the parts of a period at which they begin. */
bool tac_receive_in(tac_node *node, const uint8_t *datagram, size_t size, uint8_t piece);

/* Let an actuator act with the packets that have arrived since its last step, before its next step: when packets arrive
 * at random times, call it when the step begins and after each `tac_receive_in`; `tac_send` then returns
 * acknowledgements, and the inputs of the pieces of this step are those of `tac_input`, of which the last is to be
 * applied at once. Call `tac_step` for this step when it is over: it has all its packets, and the same inputs. Return
 * false, without effect, if the node does more than to apply packets of links that delay them at random. */
bool tac_act(tac_node *node);

/* Execute the step with number `tick`, less than UINT64_MAX. A node with a sensor reads `measurement`, in which NaN is
 * a missing entry; if it is NULL, all entries are missing. In place of a missing entry, the filter of the node uses its
 * prediction, and a node without a filter the last measurement; the node is degraded. `drawn` replaces the random draws
 * of the node, unless it is NULL. If steps were missed, a node without a sensor executes them first, at most
 * TAC_CATCH_UP in one call, so that a call takes at most the time of TAC_CATCH_UP + 1 steps. Return false, without
 * executing the step, if it is not later than the last step, if more missed steps are left (call again, with this step
 * or with a later one), or if the measurement exceeds FLT_MAX. If a result is not finite, or the packets cannot carry
 * it, the node keeps its input, sends no data, and its memory starts again. */
bool tac_step(tac_node *node, uint64_t tick, const tac_real *measurement, const tac_real *drawn);

/* Set the set-points of a controller from the next step on, in place of those in packets on the link `setpoint`. They
 * remain in effect until others are set or arrive. Return false, without effect, if they exceed FLT_MAX or the node is
 * given none. */
bool tac_setpoint(tac_node *node, const tac_real *values);

/* Write the set-points that were in effect in the last step, within their range and ramp. Return false, without effect,
 * if the node is given none. */
bool tac_setpoints(const tac_node *node, tac_real *values);

/* From the next step on, let a controller command `values`, one for each input of the plant, in its units, in place of
 * its own command; NULL: automatic, as after tac_start. The filter and the integrals of the controller follow them, and
 * the node is degraded. They remain until others are set or arrive, and are part of the saved state. Return false,
 * without effect, if they exceed FLT_MAX, or the node is no controller that can be operated by hand. */
bool tac_manual(tac_node *node, const tac_real *values);

/* Return the manual inputs, or NULL if the operation is automatic. */
const tac_real *tac_is_manual(const tac_node *node);

/* Return the number of missed steps that `tac_step` executes before step `tick`, in one call or several. Of more than
 * 10000 missed steps, the earlier ones are skipped, as on a host. */
uint64_t tac_behind(const tac_node *node, uint64_t tick);

/* Return whether a node in virtual time may begin its next step: whether every node that sends to it has finished the
 * steps that this step needs. Before the first step of a node without a sensor, a packet must have been received, which
 * shows that the others are running; one with a sensor also needs the measurement of the step, which the program has.
 * In virtual time, call `tac_mark_after(node, 0)`. */
bool tac_ready(const tac_node *node);

/* Return the step number in the newest received packet plus one, or 0 if no packet was received. A node that starts
 * while the loop runs begins with step `tac_heard(node) - 1`, so that all nodes use the same step numbers. */
uint64_t tac_heard(const tac_node *node);

/* Write the next datagram to send, of at most TAC_DATAGRAM bytes, and return its size, or 0 if there is none. After
 * missed steps, only the newest packet of each link is sent. Call it after each received datagram too: with a key, the
 * node challenges senders that have not proven that they are running, and answers challenges. A challenge or an
 * acknowledgement goes to the node from which the packets of its link come: see tac_is_back. */
size_t tac_send(tac_node *node, uint8_t *datagram);

/* Write the state of a node as bytes, which do not depend on the processor, and return their number; 0: `size` is too
 * small. As many bytes as the type of the node has suffice. The state includes neither the key nor what `tac_watch` and
 * `tac_mark_after` set. */
size_t tac_save(tac_node *node, uint8_t *bytes, size_t size);

/* Continue a started node from saved bytes: it does what the saved node would have done, bit for bit. Return false,
 * without changing the node, if the bytes are damaged, or belong to another policy, node, loop or format. */
bool tac_restore(tac_node *node, const uint8_t *bytes, size_t size);

/* An estimate of the beginning of steps by the readings of a timer, from the packets of the node that sets the time. It
 * needs no synchronised clocks: the timer may run up to 0.1 % faster or slower. A packet may be late but not early, so
 * the earliest packets determine the estimate. */
typedef struct {
  uint64_t zero;     /* reading at which step 0 began, modulo 2^64 */
  uint64_t first;    /* its first estimate */
  uint64_t last;     /* newest step of a packet */
  uint64_t jump;     /* reading at which step 0 began, if the time has jumped */
  uint64_t ticks[2]; /* steps from which the drift is measured, and the estimates then */
  uint64_t zeros[2];
  int64_t least;   /* least offset of the last packets, if all of them were late */
  uint32_t period; /* counts of the timer in a step */
  uint32_t agreed; /* consecutive packets that agree on a jump */
  uint32_t late;   /* consecutive late packets */
  uint32_t jumps;  /* jumps so far */
  bool known;      /* whether a packet has arrived */
} tac_clock;

/* Initialize a clock. `period` is the length of a step in counts of the timer, from 1; use a timer with 1000 or more
 * counts in a step. */
void tac_clock_start(tac_clock *clock, uint32_t period);

/* Process a datagram as `tac_receive` does, and update the clock if it contains new data or a new mark. `now` is the
 * reading of the timer at its arrival; readings have 64 bits and do not go back. */
bool tac_clock_receive(tac_clock *clock, tac_node *node, const uint8_t *datagram, size_t size, uint64_t now);

/* Update a clock with a packet of step `tick` that arrived at the reading `now`. An estimate that differs by more than
 * 16 steps is a jump, which is followed after 8 consecutive packets that agree. Return false if the step of the packet
 * cannot have begun. */
bool tac_clock_hear(tac_clock *clock, uint64_t tick, uint64_t now);

/* Return the number of the newest step that has begun at the reading `now`, plus one; 0: none, or unknown. For a node
 * that waits for the packets of a step, subtract the waiting time, for example half a step, from the reading. */
uint64_t tac_clock_due(const tac_clock *clock, uint64_t now);

/* Return by how many counts the timer has advanced more than the steps have, since the first packet. */
int64_t tac_clock_offset(const tac_clock *clock);

/* Return by how many parts per million the timer is faster than the steps, over the last 8192 to 16384 steps. The error
 * is about the jitter of the packets, divided by that time. */
int32_t tac_clock_drift(const tac_clock *clock);

/* Return the plant input, or NULL if the node does not contain the actuator. */
const tac_real *tac_input(const tac_node *node);

/* Return whether an event that violates an assumption of the policy's theory still has an effect, such as a silent link
 * or a step whose results are too large (`overflowed` in the counters). */
bool tac_degraded(const tac_node *node);

#ifdef __cplusplus
}
#endif

#endif

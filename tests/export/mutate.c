/* Datagrams of a small policy, changed at random and thrown at a node: `mutate COUNT SEED KEYED`. Whoever compiles this
 * checks addresses and undefined behaviour; the program itself checks that each datagram is counted once, that nothing
 * becomes infinite, and that with a key only what was written with it is accepted. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "taciturn.h"

#define REQUIRE(truth)                                                   \
  do {                                                                   \
    if (!(truth)) {                                                      \
      (void)fprintf(stderr, "line %d: not so: %s\n", __LINE__, #truth); \
      exit(1);                                                           \
    }                                                                    \
  } while (0)

enum { INPUTS = 12, MEMORY = 4, OUTPUTS = 5, CHANNELS = 2, SHAPES = 7, GOOD = 32, LONGEST = TAC_DATAGRAM + 64 };

static uint64_t drawn_word = 88172645463325252U;

/* The next word of a xorshift generator. */
static uint64_t draw(void) {
  drawn_word ^= drawn_word << 13U;
  drawn_word ^= drawn_word >> 7U;
  drawn_word ^= drawn_word << 17U;
  return drawn_word;
}

static unsigned draw_below(size_t count) {
  return (unsigned)((draw() >> 16U) % count);
}

static tac_real draw_number(void) {
  return (tac_real)((double)(draw() >> 11U) / 4503599627370496.0 - 1.0);
}

/* A clock, three numbers and their arrival of the sensor link, and an acknowledgement, in; two packets' worth out. */
static void first(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  for (unsigned i = 0U; i < (unsigned)MEMORY; i++) {
    memory[i] = (memory[i] + inputs[2U + i] + inputs[0]) * constants[0];
  }
  outputs[0] = (memory[0] > (tac_real)0) ? (tac_real)1 : (tac_real)0;
  for (unsigned i = 1U; i < (unsigned)OUTPUTS; i++) {
    outputs[i] = memory[i - 1U];
  }
}

static void second(const tac_real *constants, const tac_real *inputs, tac_real *memory, tac_real *outputs) {
  (void)outputs;
  memory[1] += inputs[9] * constants[1];
}

static const tac_real per_unit[3] = {(tac_real)32767, (tac_real)3276.7, (tac_real)327.67};
static const tac_real per_step[3] = {(tac_real)(1 / 32767.0), (tac_real)(10 / 32767.0), (tac_real)(100 / 32767.0)};
static const tac_shape shapes[SHAPES] = {
    {TAC_DATA, TAC_SENSOR_LINK, TAC_ENCODED_INT16, 3U, per_unit, per_step, false},
    {TAC_DATA, TAC_ACTUATOR_LINK, TAC_ENCODED_FLOAT32, 4U, NULL, NULL, false},
    {TAC_ACKNOWLEDGEMENT, TAC_SENSOR_LINK, TAC_ENCODED_FLOAT64, 0U, NULL, NULL, false},
    {TAC_ACKNOWLEDGEMENT, TAC_ACTUATOR_LINK, TAC_ENCODED_FLOAT64, 0U, NULL, NULL, false},
    {TAC_MARK, TAC_SENSOR_LINK, TAC_ENCODED_FLOAT64, 0U, NULL, NULL, false},
    {TAC_MARK, TAC_ACTUATOR_LINK, TAC_ENCODED_FLOAT64, 0U, NULL, NULL, false},
    {TAC_MEASUREMENT, TAC_PLANT_LINK, TAC_ENCODED_FLOAT64, 6U, NULL, NULL, true},
};
static const tac_channel_data channel_data[CHANNELS] = {
    {TAC_DATA, TAC_SENSOR_LINK, 1U, 0U, 3U, true, 1U, 0U, false, 0U},
    {TAC_ACKNOWLEDGEMENT, TAC_ACTUATOR_LINK, 1U, 1U, 0U, false, 9U, 0U, false, 0U},
};
static const tac_send_data send_data[1] = {{TAC_ACTUATOR_LINK, 4U, 0U}};
static const uint16_t following[5] = {1U, 2U, 3U, 4U, 2U};
static const tac_clock_data clock_data[1] = {{following, 5U, 3U, 0U}};
static const tac_real constants[2] = {(tac_real)0.5, (tac_real)0.125};
static const tac_real start[MEMORY] = {(tac_real)0.5};
static const tac_real safe[1] = {(tac_real)0};
static const tac_node_data data = {
    .wire = {0x0123456789ABCDEFU, shapes, SHAPES},
    .channels = channel_data,
    .sends = send_data,
    .clocks = clock_data,
    .first = first,
    .second = second,
    .constants = constants,
    .start = start,
    .constant_count = 2U,
    .remembers = 100U,
    .input_count = INPUTS,
    .memory_count = MEMORY,
    .output_count = OUTPUTS,
    .applied = 1,
    .applied_count = 1U,
    .channel_count = CHANNELS,
    .send_count = 1U,
    .clock_count = 1U,
    .lossless = true,
};

typedef struct {
  tac_node node;
  tac_channel channels[CHANNELS];
  tac_real inputs[INPUTS];
  tac_real memory[MEMORY];
  tac_real outputs[OUTPUTS];
  tac_real input[1];
  uint32_t sequences[1];
  uint16_t places[1];
} victim;

typedef struct {
  uint8_t bytes[LONGEST];
  size_t size;
} datagram;

static const uint8_t secret[32] = "thirty-two bytes are the longest";
static victim self;
static tac_key key;
static datagram good[GOOD];
static uint32_t sequences[SHAPES];
static uint64_t accepted;
static uint64_t steps;
static uint64_t sent;
static uint32_t forgotten;

static void begin(uint32_t epoch) {
  (void)memset(&self, 0xA5, sizeof self);
  self.node.data = &data;
  self.node.channels = self.channels;
  self.node.inputs = self.inputs;
  self.node.memory = self.memory;
  self.node.outputs = self.outputs;
  self.node.input = self.input;
  self.node.sequences = self.sequences;
  self.node.places = self.places;
  tac_start(&self.node, epoch, 3U, key);
  for (unsigned i = 0U; i < (unsigned)CHANNELS; i++) { /* the sender of the good packets has answered a challenge */
    self.channels[i].has_proof = true;
    self.channels[i].proven = 1U;
  }
  tac_watch(&self.node, 8U, safe);
}

/* Write a datagram that is as it should be, of about this tick, over an old one. */
static void write_good(void) {
  unsigned kind = draw_below((size_t)SHAPES);
  datagram *made = &good[draw_below((size_t)GOOD)];
  tac_packet packet;
  packet.kind = shapes[kind].kind;
  packet.link = shapes[kind].link;
  packet.entries = shapes[kind].entries;
  packet.back = false;
  packet.loop = 3U;
  packet.epoch = 1U;
  packet.sequence = sequences[kind]++;
  packet.tick = self.node.tick + draw_below(8U);
  packet.tick -= (packet.tick < 2U) ? packet.tick : 2U;
  for (unsigned i = 0U; i < packet.entries; i++) {
    packet.values[i] = draw_number();
  }
  made->size = tac_encode(&data.wire, key, &packet, made->bytes);
  REQUIRE(made->size > 0U && made->size <= (size_t)TAC_DATAGRAM);
}

/* CRC-32 bit by bit: not the node's. */
static uint32_t checksum(const uint8_t *bytes, size_t size) {
  uint32_t remainder = 0xFFFFFFFFU;
  for (size_t i = 0U; i < size; i++) {
    remainder ^= bytes[i];
    for (unsigned bit = 0U; bit < 8U; bit++) {
      remainder = (remainder >> 1U) ^ (((remainder & 1U) != 0U) ? 0xEDB88320U : 0U);
    }
  }
  return ~remainder;
}

static void reseal(datagram *made) {
  size_t around = (key.bytes == NULL) ? 4U : 20U;
  if (made->size >= around) {
    uint32_t sum = checksum(made->bytes, made->size - around);
    for (unsigned i = 0U; i < 4U; i++) {
      made->bytes[made->size - around + i] = (uint8_t)(sum >> (24U - (8U * i)));
    }
  }
}

static void flip(datagram *made) {
  if (made->size > 0U) {
    unsigned at = draw_below((draw_below(2U) == 0U) ? made->size : ((made->size < 32U) ? made->size : 32U));
    made->bytes[at] = (uint8_t)(made->bytes[at] ^ (1U << draw_below(8U)));
  }
}

static void lengthen(datagram *made) {
  unsigned more = 1U + draw_below(24U);
  for (unsigned i = 0U; i < more && made->size < (size_t)LONGEST; i++) {
    made->bytes[made->size++] = (uint8_t)draw();
  }
}

/* Put the end of another datagram behind the beginning of this one. */
static void splice(datagram *made) {
  const datagram *other = &good[draw_below((size_t)GOOD)];
  size_t at = draw_below(((made->size < other->size) ? made->size : other->size) + 1U);
  (void)memcpy(&made->bytes[at], &other->bytes[at], other->size - at);
  made->size = other->size;
}

/* Change a datagram a little, and mostly give it a right checksum again. */
static void change(datagram *made) {
  unsigned changes = draw_below(4U);
  for (unsigned i = 0U; i < changes; i++) {
    switch (draw_below(6U)) {
      case 0U:
        made->size = draw_below(made->size + 1U);
        break;
      case 1U:
        lengthen(made);
        break;
      case 2U:
        splice(made);
        break;
      default:
        flip(made);
        break;
    }
  }
  if (changes > 0U && draw_below(4U) != 0U) {
    reseal(made);
  }
}

static bool is_good(const datagram *made) {
  for (unsigned i = 0U; i < (unsigned)GOOD; i++) {
    if (made->size == good[i].size && memcmp(made->bytes, good[i].bytes, made->size) == 0) {
      return true;
    }
  }
  return false;
}

/* Give a node a datagram in memory of just its size. */
static void throw_one(const datagram *made) {
  tac_packet packet;
  const tac_counters *counted = &self.node.counters;
  uint8_t *bytes = malloc(made->size + 1U);
  uint32_t before = counted->received;
  tac_verdict verdict;
  REQUIRE(bytes != NULL);
  (void)memcpy(&bytes[1], made->bytes, made->size);
  verdict = tac_decode(&data.wire, key, &bytes[1], made->size, &packet);
  (void)tac_receive(&self.node, &bytes[1], made->size);
  free(bytes);
  REQUIRE((counted->received != before) == (verdict == TAC_OK));
  if (verdict == TAC_OK) {
    accepted++;
    REQUIRE(key.bytes == NULL || is_good(made));
  }
}

static void go_on(void) {
  uint8_t written[TAC_DATAGRAM];
  tac_packet packet;
  size_t size;
  uint64_t tick = self.node.begun ? (self.node.tick + draw_below(3U)) : 0U;
  if (draw_below(5000U) == 0U) {
    tick += draw_below(20000U);
  }
  steps += tac_step(&self.node, tick, NULL, NULL) ? 1U : 0U;
  for (size = tac_send(&self.node, written); size > 0U; size = tac_send(&self.node, written)) {
    sent++;
    REQUIRE(tac_decode(&data.wire, key, written, size, &packet) == TAC_OK);
  }
  REQUIRE(tac_input(&self.node) != NULL);
  for (unsigned i = 0U; i < (unsigned)MEMORY; i++) {
    REQUIRE(self.memory[i] - self.memory[i] >= (tac_real)0);
  }
}

static uint32_t count_waiting(void) {
  uint32_t waiting = 0U;
  for (unsigned i = 0U; i < (unsigned)CHANNELS; i++) {
    for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
      waiting += self.channels[i].waits[place] ? 1U : 0U;
    }
  }
  return waiting;
}

/* Switch the node off and on; what it has counted is kept here. */
static void begin_again(void) {
  const tac_counters counted = self.node.counters;
  forgotten += count_waiting();
  begin(7U);
  self.node.counters = counted;
}

static void check_counts(uint32_t thrown) {
  const tac_counters *c = &self.node.counters;
  uint32_t fates = c->used + c->late + c->ahead + c->duplicate + c->replayed;
  fates += c->misdirected + c->superseded + c->marks;
  REQUIRE(c->received == fates + count_waiting() + forgotten);
  REQUIRE(thrown == c->received + c->malformed + c->corrupted + c->foreign + c->forged + c->unproven + c->proofs);
}

static void print(const char *name, uint32_t count) {
  (void)printf(", \"%s\": %" PRIu32, name, count);
}

int main(int count, char **arguments) {
  uint32_t total = (count > 1) ? (uint32_t)strtoul(arguments[1], NULL, 10) : 0U;
  const tac_counters *c = &self.node.counters;
  drawn_word ^= (count > 2) ? (uint64_t)strtoul(arguments[2], NULL, 10) << 32U : 0U;
  if (count > 3 && arguments[3][0] == '1') {
    key.bytes = secret;
    key.size = (uint8_t)sizeof secret;
  }
  begin(7U);
  for (unsigned i = 0U; i < 64U * (unsigned)GOOD; i++) {
    write_good();
  }
  for (uint32_t thrown = 1U; thrown <= total; thrown++) {
    datagram made = good[draw_below((size_t)GOOD)];
    change(&made);
    throw_one(&made);
    if (draw_below(3U) == 0U) {
      write_good();
    }
    if (draw_below(1000U) == 0U) { /* since a packet of a later epoch was accepted, all others are replayed */
      begin_again();
    }
    if (draw_below(16U) == 0U) {
      go_on();
      check_counts(thrown);
    }
  }
  check_counts(total);
  (void)printf("{\"accepted\": %" PRIu64 ", \"steps\": %" PRIu64 ", \"sent\": %" PRIu64, accepted, steps, sent);
  print("malformed", c->malformed);
  print("corrupted", c->corrupted);
  print("foreign", c->foreign);
  print("forged", c->forged);
  print("used", c->used);
  print("late", c->late);
  print("ahead", c->ahead);
  print("duplicate", c->duplicate);
  print("replayed", c->replayed);
  print("misdirected", c->misdirected);
  print("superseded", c->superseded);
  print("marks", c->marks);
  (void)printf("}\n");
  return 0;
}

/* Processor-in-the-loop simulation: one node on a board executes steps that a host requests over the first UART.
 * Compile this file with
 *
 *     -DLOOP_HEADER='"NODE.h"' -DLOOP_NODE=NODE -DLOOP_START=NODE_start
 *
 * Board and host exchange frames. Numbers are big-endian; measurements and inputs are doubles. Sizes in bytes are in
 * parentheses, and (1) after a plural is a count:
 *
 *     frame     0x54, size of the body (2), body, CRC-32 of the body as in zlib (4)
 *     question  step (8), datagrams (1), size (2) and bytes of each, measurements (1), each (8)
 *     answer    step (8), flags (1), datagrams (1), size (2) and bytes of each, inputs (1), each (8)
 *
 * Flags: 1, the step was executed; 2, the node is degraded; 4, the node has an input. At the start, the board sends an
 * answer with the invalid step number 2^64 - 1. The board does not answer a damaged question. If the host repeats a
 * question because its answer was lost, the board repeats the answer and does not execute the step again.
 */
#include <string.h>

#include "board.h"
#include LOOP_HEADER

enum { UART_DATA = 0, UART_STATE = 4, UART_CONTROL = 8, UART_INTERRUPT = 12, UART_DIVIDER = 16 };
enum { TRANSMIT_FULL = 1, RECEIVE_FULL = 2, ENABLED = 0x0B /* both directions, and the receive interrupt */ };
enum { BEGIN = 0x54, MOST_DATAGRAMS = 8, MOST_NUMBERS = 255, CRC_BYTES = 4 };
enum { GONE_THROUGH = 1, DEGRADED = 2, HAS_INPUT = 4 };
#define UART(what) BOARD_REGISTER(0x40004000U + (uint32_t)(what))
#define ENABLE_INTERRUPT BOARD_REGISTER(0xE000E100U)
#define CLEAR_INTERRUPT BOARD_REGISTER(0xE000E280U)

typedef struct {
  uint8_t bytes[16 + (MOST_DATAGRAMS * (2 + TAC_DATAGRAM)) + (8 * MOST_NUMBERS)];
  size_t size;
} body;

static body question, answer;
static LOOP_NODE memory;

static void start_uart(void) {
  UART(UART_DIVIDER) = 16U;
  UART(UART_CONTROL) = ENABLED;
  __asm volatile("cpsid i"); /* an interrupt wakes the processor, but has no handler */
  ENABLE_INTERRUPT = 1U;
}

static uint8_t read_byte(void) {
  uint8_t byte;
  while ((UART(UART_STATE) & RECEIVE_FULL) == 0U) {
    __asm volatile("wfi");
  }
  byte = (uint8_t)UART(UART_DATA);
  UART(UART_INTERRUPT) = RECEIVE_FULL;
  CLEAR_INTERRUPT = 1U;
  return byte;
}

static void write_byte(uint8_t byte) {
  while ((UART(UART_STATE) & TRANSMIT_FULL) != 0U) {
  }
  UART(UART_DATA) = byte;
}

static uint32_t checksum(const body *of) {
  uint32_t remainder = UINT32_MAX;
  for (size_t i = 0U; i < of->size; i++) {
    remainder ^= of->bytes[i];
    for (unsigned bit = 0U; bit < 8U; bit++) {
      remainder = (remainder >> 1U) ^ (((remainder & 1U) != 0U) ? 0xEDB88320U : 0U);
    }
  }
  return ~remainder;
}

static uint32_t read_number(unsigned bytes) {
  uint32_t value = 0U;
  for (unsigned i = 0U; i < bytes; i++) {
    value = (value << 8U) | read_byte();
  }
  return value;
}

/* Wait for a frame, and return false if it is damaged. */
static bool read_frame(body *to) {
  while (read_byte() != (uint8_t)BEGIN) {
  }
  to->size = read_number(2U);
  if (to->size > sizeof to->bytes) {
    return false;
  }
  for (size_t i = 0U; i < to->size; i++) {
    to->bytes[i] = read_byte();
  }
  return read_number((unsigned)CRC_BYTES) == checksum(to);
}

static void write_frame(const body *from) {
  uint32_t remainder = checksum(from);
  write_byte((uint8_t)BEGIN);
  write_byte((uint8_t)(from->size >> 8U));
  write_byte((uint8_t)(from->size & 0xFFU));
  for (size_t i = 0U; i < from->size; i++) {
    write_byte(from->bytes[i]);
  }
  for (unsigned i = 0U; i < (unsigned)CRC_BYTES; i++) {
    write_byte((uint8_t)((remainder >> (24U - (8U * i))) & 0xFFU));
  }
}

static void put(body *to, uint64_t value, unsigned bytes) {
  for (unsigned i = 0U; i < bytes; i++) {
    to->bytes[to->size] = (uint8_t)((value >> (8U * (bytes - 1U - i))) & 0xFFU);
    to->size++;
  }
}

static void put_double(body *to, tac_real value) {
  double wide = (double)value;
  uint64_t bits;
  (void)memcpy(&bits, &wide, sizeof bits);
  put(to, bits, 8U);
}

/* Return the next number of `bytes` bytes, and advance `at`; beyond the end of the body all bytes are 0. */
static uint64_t take(const body *from, size_t *at, unsigned bytes) {
  uint64_t value = 0U;
  for (unsigned i = 0U; i < bytes; i++) {
    value = (value << 8U) | ((*at < from->size) ? from->bytes[*at] : 0U);
    (*at)++;
  }
  return value;
}

static tac_real take_double(const body *from, size_t *at) {
  uint64_t bits = take(from, at, 8U);
  double wide;
  (void)memcpy(&wide, &bits, sizeof wide);
  return (tac_real)wide;
}

/* Execute the step that a question requests, and write the answer. */
static void respond(tac_node *node, uint64_t tick) {
  static tac_real measurement[MOST_NUMBERS];
  size_t at = 8U;
  size_t flags;
  size_t counted;
  size_t size;
  unsigned count = (unsigned)take(&question, &at, 1U);
  for (unsigned i = 0U; i < count; i++) {
    size = (size_t)take(&question, &at, 2U);
    if (at + size <= question.size) {
      (void)tac_receive(node, &question.bytes[at], size);
    }
    at += size;
  }
  count = (unsigned)take(&question, &at, 1U);
  for (unsigned i = 0U; i < count; i++) {
    measurement[i] = take_double(&question, &at);
  }
  answer.size = 0U;
  put(&answer, tick, 8U);
  flags = answer.size;
  put(&answer, tac_step(node, tick, (count > 0U) ? measurement : NULL, NULL) ? GONE_THROUGH : 0U, 1U);
  counted = answer.size;
  put(&answer, 0U, 1U);
  while (answer.bytes[counted] < (uint8_t)MOST_DATAGRAMS) {
    size = tac_send(node, &answer.bytes[answer.size + 2U]);
    if (size == 0U) {
      break;
    }
    put(&answer, size, 2U);
    answer.size += size;
    answer.bytes[counted]++;
  }
  count = (tac_input(node) == NULL) ? 0U : node->data->applied_count;
  put(&answer, count, 1U);
  for (unsigned i = 0U; i < count; i++) {
    put_double(&answer, tac_input(node)[i]);
  }
  answer.bytes[flags] |= (uint8_t)((tac_degraded(node) ? DEGRADED : 0U) | ((count > 0U) ? HAS_INPUT : 0U));
}

int main(void) {
  const tac_key none = {NULL, 0U};
  tac_node *node = LOOP_START(&memory, 0U, 0U, none);
  uint64_t answered = UINT64_MAX;
  if (node == NULL) {
    return 1; /* the data of the node are damaged */
  }
  start_uart();
  put(&answer, answered, 8U);
  put(&answer, 0U, 3U);
  write_frame(&answer);
  for (;;) {
    if (read_frame(&question) && question.size >= 8U) {
      size_t at = 0U;
      uint64_t tick = take(&question, &at, 8U);
      if (tick != answered) {
        respond(node, tick);
        answered = tick;
      }
      write_frame(&answer);
    }
  }
}

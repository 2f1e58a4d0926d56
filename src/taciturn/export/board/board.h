/* Arm's MPS2 boards, as QEMU emulates them: a timer that counts instructions. Not for a device. */
#ifndef TACITURN_BOARD_H
#define TACITURN_BOARD_H

#include <stdint.h>

/* One register. */
#define BOARD_REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))

/* QEMU with `-icount shift=7` lets every instruction take 128 ns; the timer counts down every 40 ns. What is between two
 * readings is known to one count, which is less than a third of an instruction: rounded, it is the number of
 * instructions. With shift=0 an instruction would take 1 ns, and 40 of them could not be told apart. */
enum { BOARD_TIMER_STEPS = 16, BOARD_INSTRUCTIONS = 5 }; /* as many steps of the timer as instructions */
#define BOARD_TIMER 0x40000000U

/* Let the timer run. */
static inline void board_start_timer(void) {
  BOARD_REGISTER(BOARD_TIMER + 8U) = UINT32_MAX; /* reload */
  BOARD_REGISTER(BOARD_TIMER + 4U) = UINT32_MAX; /* value */
  BOARD_REGISTER(BOARD_TIMER) = 1U;
}

/* Return the value of the timer. */
static inline uint32_t board_now(void) {
  return BOARD_REGISTER(BOARD_TIMER + 4U);
}

/* Return how many instructions are between two readings, the second one's own among them. */
static inline uint32_t board_instructions(uint32_t begun, uint32_t ended) {
  uint64_t steps = begun - ended;
  return (uint32_t)((steps * BOARD_INSTRUCTIONS + BOARD_TIMER_STEPS / 2U) / BOARD_TIMER_STEPS);
}

#endif

/* Arm MPS2 boards as emulated by QEMU, with a timer that counts instructions. Not for a device. */
#ifndef TACITURN_BOARD_H
#define TACITURN_BOARD_H

#include <stdint.h>

/* Access to the register at an address. */
#define BOARD_REGISTER(address) (*(volatile uint32_t *)(uintptr_t)(address))

/* In QEMU with `-icount shift=7`, every instruction takes 128 ns, and the timer counts down every 40 ns. The time
 * between two readings is known to one count, which is less than a third of an instruction, so rounding gives the exact
 * number of instructions. With shift=0 an instruction would take 1 ns, and the resolution would be 40 instructions. */
enum { BOARD_TIMER_STEPS = 16, BOARD_INSTRUCTIONS = 5 }; /* 16 counts of the timer are 5 instructions */
#define BOARD_TIMER 0x40000000U

/* Start the timer. */
static inline void board_start_timer(void) {
  BOARD_REGISTER(BOARD_TIMER + 8U) = UINT32_MAX; /* reload */
  BOARD_REGISTER(BOARD_TIMER + 4U) = UINT32_MAX; /* value */
  BOARD_REGISTER(BOARD_TIMER) = 1U;
}

/* Return the value of the timer. */
static inline uint32_t board_now(void) {
  return BOARD_REGISTER(BOARD_TIMER + 4U);
}

/* Return the number of instructions between two readings, including that of the second reading. */
static inline uint32_t board_instructions(uint32_t begun, uint32_t ended) {
  uint64_t steps = begun - ended;
  return (uint32_t)((steps * BOARD_INSTRUCTIONS + BOARD_TIMER_STEPS / 2U) / BOARD_TIMER_STEPS);
}

#endif

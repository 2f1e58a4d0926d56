/* Start-up code of a board, and the report of a processor fault to the host. Not for a device. */
#include <stdlib.h>

#include "board.h"

enum { WRITE_TEXT = 4, GET_COMMAND_LINE = 0x15 }; /* Arm semihosting calls */
enum { WORDS = 8, LINE = 256, FAULT = 99 };

extern uint32_t board_data[], board_data_end[], board_data_values[], board_bss[], board_bss_end[], board_stack[];
extern void initialise_monitor_handles(void); /* newlib function that opens host files */
extern int main(int count, char **arguments);
void board_reset(void);
void _init(void);
void _fini(void);

/* newlib calls these functions, which are empty. */
void _init(void) {
}

void _fini(void) {
}

static int ask_host(int what, void *with) {
  register int r0 __asm("r0") = what;
  register void *r1 __asm("r1") = with;
  __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}

/* Read the command line from the host, split it into words, and return the number of words. */
static int split_command_line(char *line, char **words) {
  struct {
    char *at;
    int size;
  } where = {line, LINE};
  int count = 0;
  if (ask_host(GET_COMMAND_LINE, &where) != 0) {
    return 0;
  }
  for (char *at = line; *at != '\0' && count < WORDS - 1;) {
    words[count] = at;
    count++;
    while (*at != '\0' && *at != ' ') {
      at++;
    }
    while (*at == ' ') {
      *at = '\0';
      at++;
    }
  }
  return count;
}

void board_reset(void) {
  static char line[LINE];
  static char *words[WORDS];
  const uint32_t *from = board_data_values;
  for (uint32_t *to = board_data; to < board_data_end; to++, from++) {
    *to = *from;
  }
  for (uint32_t *to = board_bss; to < board_bss_end; to++) {
    *to = 0U;
  }
#if defined(__ARM_FP)
  BOARD_REGISTER(0xE000ED88U) |= 0xFU << 20U; /* enable the floating-point unit, which is off after reset */
  __asm volatile("dsb\n\tisb" ::: "memory");
#endif
  initialise_monitor_handles();
  exit(main(split_command_line(line, words), words));
}

static void fail(void) {
  static char text[] = "the processor met a fault; expected a program that meets none\n";
  (void)ask_host(WRITE_TEXT, text);
  _Exit(FAULT);
}

/* The vector table: initial stack pointer, reset handler and fault handlers. */
typedef union {
  uint32_t *stack;
  void (*handler)(void);
} vector;
extern const vector board_vectors[];
__attribute__((section(".vectors"), used)) const vector board_vectors[16] = {
    {.stack = board_stack}, {.handler = board_reset}, {.handler = fail}, {.handler = fail},
    {.handler = fail},      {.handler = fail},        {.handler = fail},
};

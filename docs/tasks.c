/* Two nodes as tasks that never wait: the sensor's interrupt and the network hand datagrams to queues, and each task
 * takes them in its loop. On this machine threads take the place of the interrupt and of the tasks of an RTOS.
 *
 * The program needs the folder of `taciturn export two-mass --c nodes`, without the self-check:
 *
 *     cc -std=c99 -Inodes tasks.c nodes/taciturn_*.c nodes/two_mass_*.c -lpthread -o tasks && ./tasks
 *
 * It prints the input of each step, and at the end how many packets were sent. */
#define _POSIX_C_SOURCE 200809L
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <string.h>

#include "two_mass_actuator.h"
#include "two_mass_controller.h"

enum { STEPS = 200, ROOM = 8, MEASURED = 2, APPLIED = 1 };

/* Queues of datagrams: the only data that two tasks, or a task and an interrupt, share. ------------------------------
 *
 * On a single core without an RTOS, `lock` disables interrupts and `unlock` restores them. With an RTOS, use its queue:
 * xQueueSendFromISR and xQueueReceive with a timeout of 0 (FreeRTOS), k_msgq_put and k_msgq_get with K_NO_WAIT (Zephyr).
 */
typedef struct {
  uint8_t bytes[TAC_DATAGRAM];
  size_t size;
} letter;

typedef struct {
  letter letters[ROOM];
  size_t first;
  size_t count;
  unsigned dropped; /* because the queue was full, as a network drops packets */
} queue;

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;

static void lock(void) { (void)pthread_mutex_lock(&mutex); }

static void unlock(void) { (void)pthread_mutex_unlock(&mutex); }

/* Put a datagram into a queue. It copies at most TAC_DATAGRAM bytes and never waits, so an interrupt may call it. */
static void put(queue *to, const uint8_t *bytes, size_t size) {
  lock();
  if (size > sizeof to->letters[0].bytes || to->count == (size_t)ROOM) {
    to->dropped++;
  } else {
    letter *last = &to->letters[(to->first + to->count) % (size_t)ROOM];
    (void)memcpy(last->bytes, bytes, size);
    last->size = size;
    to->count++;
  }
  unlock();
}

/* Take the oldest datagram of a queue, and return its size; 0: the queue is empty. */
static size_t take(queue *from, uint8_t *bytes) {
  size_t size = 0U;
  lock();
  if (from->count > 0U) {
    size = from->letters[from->first].size;
    (void)memcpy(bytes, from->letters[from->first].bytes, size);
    from->first = (from->first + 1U) % (size_t)ROOM;
    from->count--;
  }
  unlock();
  return size;
}

static queue to_controller; /* measurements of the sensor, and packets of the network */
static queue to_actuator;
static queue to_plant;

static const tac_key no_key = {NULL, 0U}; /* or a secret of 16 to 32 bytes */

/* The task of the controller. Only this task calls functions with its node. -------- */

typedef struct {
  two_mass_controller memory;
  tac_node *node;
  tac_packet measurement;
  bool measured; /* whether the step of the measurement is still to be executed */
  unsigned sent;
} controller_task;

static bool start_controller(controller_task *task) {
  task->node = two_mass_controller_start(&task->memory, 1U, 0U, no_key);
  if (task->node != NULL) {
    /* after each step a mark, by which the actuator knows that the step is over */
    tac_mark_after(task->node, 0U);
  }
  return task->node != NULL;
}

/* Do all that can be done now, and return. */
static void poll_controller(controller_task *task) {
  uint8_t datagram[TAC_DATAGRAM];
  tac_packet packet;
  size_t size;
  while (!task->measured && (size = take(&to_controller, datagram)) > 0U) {
    const tac_wire *wire = &task->node->data->wire;
    tac_verdict verdict = tac_decode(wire, no_key, datagram, size, &packet);
    if (verdict == TAC_OK && packet.kind == (uint8_t)TAC_MEASUREMENT) {
      task->measurement = packet;
      task->measured = true;
    } else {
      /* which also counts what is refused */
      (void)tac_receive(task->node, datagram, size);
    }
  }
  if (task->measured) {
    (void)tac_step(task->node, task->measurement.tick, task->measurement.values, NULL);
    task->measured = false;
  }
  while ((size = tac_send(task->node, datagram)) > 0U) {
    /* byte 5 is the kind of the packet */
    task->sent += (datagram[5] == (uint8_t)TAC_DATA) ? 1U : 0U;
    put(&to_actuator, datagram, size);
  }
}

/* The task of the actuator. -------------------------------------------------------- */

typedef struct {
  two_mass_actuator memory;
  tac_node *node;
  uint64_t tick; /* next step */
} actuator_task;

static bool start_actuator(actuator_task *task) {
  task->node = two_mass_actuator_start(&task->memory, 1U, 0U, no_key);
  return task->node != NULL;
}

static void poll_actuator(actuator_task *task) {
  uint8_t datagram[TAC_DATAGRAM];
  size_t size;
  while ((size = take(&to_actuator, datagram)) > 0U) {
    (void)tac_receive(task->node, datagram, size);
  }
  while (tac_ready(task->node) && tac_step(task->node, task->tick, NULL, NULL)) {
    tac_packet input = {0};
    input.kind = (uint8_t)TAC_INPUT;
    input.link = (uint8_t)TAC_PLANT_LINK;
    input.tick = task->tick;
    input.sequence = (uint32_t)task->tick;
    input.epoch = 1U;
    input.entries = (uint8_t)APPLIED;
    (void)memcpy(input.values, tac_input(task->node), APPLIED * sizeof(tac_real));
    size = tac_encode(&task->node->data->wire, no_key, &input, datagram);
    put(&to_plant, datagram, size);
    task->tick++;
  }
}

/* This machine: a thread for each task, and the plant, whose sensor interrupts. ------------------------------------ */

static controller_task controller;
static actuator_task actuator;
static bool over;

static bool is_over(void) {
  bool found;
  lock();
  found = over;
  unlock();
  return found;
}

static void *run_controller(void *nothing) {
  while (!is_over()) {
    poll_controller(&controller);
    (void)sched_yield(); /* or sleep until the next interrupt, or wait for the queue with a timeout */
  }
  return nothing;
}

static void *run_actuator(void *nothing) {
  while (!is_over()) {
    poll_actuator(&actuator);
    (void)sched_yield();
  }
  return nothing;
}

/* The interrupt of the sensor. */
static void measure(uint64_t tick) {
  uint8_t datagram[TAC_DATAGRAM];
  tac_packet packet = {0};
  packet.kind = (uint8_t)TAC_MEASUREMENT;
  packet.link = (uint8_t)TAC_PLANT_LINK;
  packet.tick = tick;
  packet.sequence = (uint32_t)tick;
  packet.epoch = 1U;
  packet.entries = (uint8_t)MEASURED;
  for (uint64_t i = 0U; i < (uint64_t)MEASURED; i++) {
    packet.values[i] = (tac_real)((double)(((tick * 7919U) + (i * 104729U)) % 2001U) / 1000.0 - 1.0);
  }
  put(&to_controller, datagram, tac_encode(&controller.node->data->wire, no_key, &packet, datagram));
}

int main(void) {
  pthread_t threads[2];
  uint8_t datagram[TAC_DATAGRAM];
  tac_packet packet;
  if (!start_controller(&controller) || !start_actuator(&actuator) ||
      pthread_create(&threads[0], NULL, run_controller, NULL) != 0 ||
      pthread_create(&threads[1], NULL, run_actuator, NULL) != 0) {
    return 1;
  }
  for (uint64_t tick = 0U; tick < (uint64_t)STEPS; tick++) {
    size_t size;
    measure(tick);
    while ((size = take(&to_plant, datagram)) == 0U) {
      (void)sched_yield(); /* the plant waits for its input, so that every run prints the same */
    }
    if (tac_decode(&actuator.node->data->wire, no_key, datagram, size, &packet) != TAC_OK || packet.tick != tick) {
      return 2;
    }
    (void)printf("%.17g\n", (double)packet.values[0]);
  }
  lock();
  over = true;
  unlock();
  (void)pthread_join(threads[0], NULL);
  (void)pthread_join(threads[1], NULL);
  (void)printf("%u of %d packets sent, %u dropped\n", controller.sent, (int)STEPS,
               to_controller.dropped + to_actuator.dropped + to_plant.dropped);
  return 0;
}

/* A firmware for the STM32F405 of a Crazyflie that uses what a flying one uses, in as little as possible.
 *
 * A kernel of its own keeps its tasks in structures with FreeRTOS's names, members in another order, so that what reads
 * them has to ask the debugging information. Two tasks of one priority fill all FP registers and look at them again;
 * one filters samples that an EXTI interrupt of 1 kHz puts into a queue, guarded by BASEPRI; one reads the EEPROM by
 * DMA, moves a servo's timer, sends DSHOT by DMA and captures the answer, and reports over the USART by DMA. The word
 * `planted` has one of them go wrong.
 * `scenario` runs one of the small experiments with exceptions (exceptions.c) instead.
 */
#include "registers.h"

#define KEPT __attribute__((section(".kept")))
#define LENGTH(array) (sizeof(array) / sizeof((array)[0]))
#define MASK_PRIORITY 0x50u  /* interrupts from here on may call the kernel */
#define STACK_WORDS 256u
#define MAGIC_ASSERT 0x2F8A001Fu
#define assert_that(condition) ((condition) ? (void)0 : assertFail(#condition, __FILE__, __LINE__))

enum planted {
  NOTHING, BUS_FAULT, UNDEFINED, ASSERTION, HUNGRY_WATCHDOG, NULL_CALL, NULL_READ, NULL_WRITE, DIVISION, HANG, OVERFLOW,
  BRIEF_OVERFLOW, LAST_CALL, MUTEX, SUSPENDED, DELAYED, DELETED, UNALIGNED, BREAKPOINT, MASKED_CALL, WILD_WRITE
};
enum { ASSERTED = 1 };

#ifdef USUAL_PLACES /* the layout of FreeRTOS V10; without it, one that only the debugging information describes */
typedef struct xLIST_ITEM {
  uint32_t xItemValue;
  struct xLIST_ITEM *pxNext, *pxPrevious;
  void *pvOwner;
  struct xLIST *pxContainer;
} ListItem_t;

typedef struct xLIST {
  uint32_t uxNumberOfItems;
  ListItem_t *pxIndex;
  struct {
    uint32_t xItemValue;
    ListItem_t *pxNext, *pxPrevious;
  } xListEnd;
} List_t;

typedef struct tskTaskControlBlock {
  uint32_t *pxTopOfStack;
  ListItem_t xStateListItem, xEventListItem;
  uint32_t uxPriority, *pxStack;
  char pcTaskName[8];
  uint32_t uxBasePriority;
  volatile uint8_t ucNotifyState[1];
} TCB_t;
#else
typedef struct xLIST_ITEM {
  struct xLIST_ITEM *pxNext, *pxPrevious;
  void *pvOwner;
  struct xLIST *pxContainer;
  uint32_t xItemValue;
} ListItem_t;

typedef struct xMINI_LIST_ITEM {
  ListItem_t *pxNext, *pxPrevious;
} MiniListItem_t;

typedef struct xLIST {
  union {
    ListItem_t xListEnd; /* a whole item, so that the list closes upon itself */
  };
  uint32_t uxNumberOfItems;
} List_t;

typedef struct tskTaskControlBlock {
  uint32_t *pxTopOfStack; /* first: the handler of PendSV knows it there */
  char pcTaskName[8];
  uint32_t *pxStack;
  uint32_t uxPriority, uxBasePriority;
  ListItem_t xEventListItem, xStateListItem;
  volatile uint8_t ucNotifyState[1];
} TCB_t;
#endif

typedef struct QueueDefinition {
  uint32_t uxItemSize, uxLength, uxMessagesWaiting;
  List_t xTasksWaitingToReceive, xTasksWaitingToSend;
  union {
    struct {
      TCB_t *xMutexHolder;
    } xSemaphore;
  } u;
  int8_t *pcHead; /* none for a mutex */
} Queue_t;

struct SNAPSHOT_DATA {
  uint32_t magicNumber, type;
  union {
    struct {
      const char *fileName;
      int line;
    } file;
  };
};

KEPT volatile uint32_t planted, scenario;
KEPT volatile uint32_t outbox_size; /* bytes of `outbox` to send instead of the next line */
volatile uint8_t outbox[64], inbox[1024];
KEPT struct SNAPSHOT_DATA snapshot;

TCB_t *volatile pxCurrentTCB;
volatile uint32_t xTickCount, uxCurrentNumberOfTasks, xSchedulerRunning;
static List_t pxReadyTasksLists[4], xDelayedTaskList1, xSuspendedTaskList, xPendingReadyList, waiting_for_samples;
static List_t xTasksWaitingTermination;
static Queue_t bus_guard;
static List_t *volatile pxDelayedTaskList = &xDelayedTaskList1;
static uint32_t stacks[6][STACK_WORDS] __attribute__((aligned(8)));
static TCB_t tasks[6];

volatile uint32_t fp_errors, fp_rounds[2], samples_taken, samples_lost, i2c_reads, dma_interrupts, lines_sent, bytes_received;
volatile uint32_t last_received;
volatile uint8_t eeprom[4];
volatile uint32_t throttle, edges[22], edge_count; /* of the last reply */
static uint32_t pulses[17];
volatile float filtered;
static volatile uint32_t queue[8], queue_head, queue_tail;

extern uint32_t data_load[], data_begin[], data_end[], bss_begin[], bss_end[], main_stack_top[];
void run_scenario(uint32_t number);

__attribute__((noinline)) void assertFail(const char *expression, const char *file, int line) {
  __asm volatile("cpsid i" ::"r"(expression)); /* a debugger finds it there */
  snapshot.magicNumber = MAGIC_ASSERT;
  snapshot.type = ASSERTED;
  snapshot.file.fileName = file;
  snapshot.file.line = line;
  SCB_AIRCR = 0x05FA0004; /* SYSRESETREQ */
  for (;;) {
  }
}

static uint32_t mask(void) {
  uint32_t before;
  __asm volatile("mrs %0, basepri\n msr basepri, %1\n isb" : "=&r"(before) : "r"(MASK_PRIORITY) : "memory");
  return before;
}

static void unmask(uint32_t before) {
  __asm volatile("msr basepri, %0\n isb" ::"r"(before) : "memory");
}

#define END_OF(list) ((ListItem_t *)&(list)->xListEnd)

static void empty(List_t *list) {
  list->xListEnd.pxNext = list->xListEnd.pxPrevious = END_OF(list);
  list->xListEnd.xItemValue = 0xFFFFFFFF;
#ifdef USUAL_PLACES
  list->pxIndex = END_OF(list);
#endif
  list->uxNumberOfItems = 0;
}

static void put(List_t *list, ListItem_t *item) {
  item->pxPrevious = list->xListEnd.pxPrevious;
  item->pxNext = END_OF(list);
  item->pxPrevious->pxNext = list->xListEnd.pxPrevious = item;
  item->pxContainer = list;
  list->uxNumberOfItems++;
}

static void take(ListItem_t *item) {
  item->pxPrevious->pxNext = item->pxNext;
  item->pxNext->pxPrevious = item->pxPrevious;
  item->pxContainer->uxNumberOfItems--;
  item->pxContainer = 0;
}

static void ready(TCB_t *task) {
  take(&task->xStateListItem);
  put(&pxReadyTasksLists[task->uxPriority], &task->xStateListItem);
  SCB_ICSR = PENDSVSET;
}

static void delay(uint32_t ticks) {
  uint32_t before = mask();
  TCB_t *task = pxCurrentTCB;
  task->xStateListItem.xItemValue = xTickCount + ticks;
  take(&task->xStateListItem);
  put(pxDelayedTaskList, &task->xStateListItem);
  SCB_ICSR = PENDSVSET;
  unmask(before);
}

/* Called by PendSV: the longest waiting ready task of the highest priority. */
__attribute__((used)) void vTaskSwitchContext(void) {
  uint32_t priority = LENGTH(pxReadyTasksLists);
  while (!pxReadyTasksLists[--priority].uxNumberOfItems) {
  }
  ListItem_t *first = pxReadyTasksLists[priority].xListEnd.pxNext;
  take(first);
  put(&pxReadyTasksLists[priority], first);
  pxCurrentTCB = first->pvOwner;
}

__attribute__((naked)) void PendSV_Handler(void) {
  __asm volatile(
      "mrs r0, psp\n"
      "ldr r2, =pxCurrentTCB\n"
      "ldr r1, [r2]\n"
      "cbz r1, 1f\n" /* nobody ran yet */
      "tst lr, #0x10\n it eq\n vstmdbeq r0!, {s16-s31}\n"
      "stmdb r0!, {r4-r11, lr}\n"
      "str r0, [r1]\n"
      "1: mov r3, %0\n msr basepri, r3\n isb\n"
      "push {r2, lr}\n bl vTaskSwitchContext\n pop {r2, lr}\n"
      "mov r3, #0\n msr basepri, r3\n"
      "ldr r1, [r2]\n ldr r0, [r1]\n"
      "ldmia r0!, {r4-r11, lr}\n"
      "tst lr, #0x10\n it eq\n vldmiaeq r0!, {s16-s31}\n"
      "msr psp, r0\n isb\n bx lr\n"
      ".ltorg" ::"i"(MASK_PRIORITY));
}

__attribute__((used)) static void tick(void) {
  uint32_t before = mask();
  xTickCount++;
  for (ListItem_t *item = pxDelayedTaskList->xListEnd.pxNext, *next; item != END_OF(pxDelayedTaskList); item = next) {
    next = item->pxNext;
    if ((int32_t)(xTickCount - item->xItemValue) >= 0) {
      ready(item->pvOwner);
    }
  }
  SCB_ICSR = PENDSVSET;
  unmask(before);
}

__attribute__((naked)) void SysTick_Handler(void) {
  __asm volatile("ldr r0, =scenario\n ldr r0, [r0]\n cbnz r0, 1f\n b tick\n 1: b Scenario_SysTick\n .ltorg");
}

__attribute__((noinline)) static void leave_for(List_t *list) {
  uint32_t before = mask();
  take(&pxCurrentTCB->xStateListItem);
  put(list, &pxCurrentTCB->xStateListItem);
  SCB_ICSR = PENDSVSET;
  unmask(before);
}

/* The name in FreeRTOS's queue.c by which the structure of its queues is found. */
__attribute__((noinline, used)) void xQueueGenericSend(Queue_t *queue) { queue->uxMessagesWaiting++; }

/* Waits for a mutex that another task holds for ever. */
__attribute__((noinline)) static void lock_bus(void) {
  bus_guard.uxLength = 1;
  bus_guard.u.xSemaphore.xMutexHolder = &tasks[1];
  empty(&bus_guard.xTasksWaitingToReceive);
  put(&bus_guard.xTasksWaitingToReceive, &pxCurrentTCB->xEventListItem);
  leave_for(&xSuspendedTaskList);
}

/* One kHz: the gyro has a sample. */
void EXTI15_10_Handler(void) {
  EXTI_PR = 1u << 14;
  uint32_t before = mask();
  if (queue_head - queue_tail < LENGTH(queue)) {
    queue[queue_head++ % LENGTH(queue)] = TIM_CNT(TIM7);
  } else {
    samples_lost++;
  }
  if (waiting_for_samples.uxNumberOfItems) {
    TCB_t *task = waiting_for_samples.xListEnd.pxNext->pvOwner;
    take(&task->xEventListItem);
    ready(task);
  }
  unmask(before);
}

static uint32_t receive(void) {
  for (;;) {
    uint32_t before = mask();
    if (queue_head != queue_tail) {
      uint32_t value = queue[queue_tail++ % LENGTH(queue)];
      unmask(before);
      return value;
    }
    TCB_t *task = pxCurrentTCB;
    put(&waiting_for_samples, &task->xEventListItem);
    take(&task->xStateListItem);
    put(&xSuspendedTaskList, &task->xStateListItem);
    SCB_ICSR = PENDSVSET;
    unmask(before);
  }
}

void DMA1_Stream0_Handler(void) {
  DMA_LIFCR(DMA1) = 0x3D;
  I2C1_CR1 |= 1u << 9; /* STOP */
  dma_interrupts++;
}

/* The frame has left: capture both edges at the same channel. */
void DMA1_Stream6_Handler(void) {
  TIM_DIER(TIM2) = 0;
  DMA_HIFCR(DMA1) = 0x3Du << 16;
  TIM_CR1(TIM2) = 0;
  TIM_CCER(TIM2) = 0;
  TIM_ARR(TIM2) = 8400; /* 100 us */
  TIM_CNT(TIM2) = 0;
  TIM_CCMR1(TIM2) = 1u << 8;
  TIM_CCER(TIM2) = 11u << 4;
  DMA_M0AR(DMA1, 6) = (uint32_t)edges;
  DMA_NDTR(DMA1, 6) = LENGTH(edges);
  DMA_CR(DMA1, 6) = 3u << 25 | 2u << 13 | 2u << 11 | 1u << 10 | 1u;
  TIM_DIER(TIM2) = 1u << 10;
  TIM_CR1(TIM2) = 1;
}

static void send_frame(void) {
  edge_count = LENGTH(edges) - DMA_NDTR(DMA1, 6);
  TIM_DIER(TIM2) = TIM_CR1(TIM2) = DMA_CR(DMA1, 6) = 0;
  DMA_HIFCR(DMA1) = 0x3Du << 16;
  uint32_t data = throttle << 1, frame = data << 4 | (~(data ^ data >> 4 ^ data >> 8) & 15);
  for (uint32_t i = 0; i < 16; i++) {
    pulses[i] = frame >> (15 - i) & 1 ? 210 : 105;
  }
  TIM_ARR(TIM2) = 280; /* 300 kHz */
  TIM_CNT(TIM2) = 0;
  TIM_CCMR1(TIM2) = 6u << 12 | 1u << 11; /* PWM, preloaded */
  TIM_CCER(TIM2) = 3u << 4;              /* inverted */
  TIM_CCR2(TIM2) = 0;
  DMA_PAR(DMA1, 6) = (uint32_t)&TIM_CCR2(TIM2);
  DMA_M0AR(DMA1, 6) = (uint32_t)pulses;
  DMA_NDTR(DMA1, 6) = LENGTH(pulses);
  DMA_CR(DMA1, 6) = 3u << 25 | 2u << 13 | 2u << 11 | 1u << 10 | 1u << 6 | 1u << 4 | 1u;
  TIM_DIER(TIM2) = 1u << 10; /* the request of channel 2 */
  TIM_CR1(TIM2) = 1;
}

void USART6_Handler(void) {
  if (USART6_SR & (1u << 5)) {
    last_received = USART6_DR;
    inbox[bytes_received++ % sizeof inbox] = last_received;
  }
}

/* Writes s0 to s31, waits long enough to be interrupted, and returns how many of them have changed. */
__attribute__((naked, noinline)) static uint32_t check_fp_registers(__attribute__((unused)) uint32_t first) {
  __asm volatile(
      "vpush {s16-s31}\n mov r1, r0\n"
      ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n"
      "vmov s\\n, r1\n adds r1, #1\n .endr\n"
      "movw r2, #2000\n 1: subs r2, #1\n bne 1b\n"
      "movs r3, #0\n"
      ".irp n,0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31\n"
      "vmov r2, s\\n\n cmp r2, r0\n it ne\n addne r3, #1\n adds r0, #1\n .endr\n"
      "vpop {s16-s31}\n mov r0, r3\n bx lr\n");
}

static void spin(uint32_t number) {
  for (;;) {
    fp_errors += check_fp_registers(0x40000000u + (number << 16));
    fp_rounds[number]++;
#ifdef CALM /* for flights of more than a second: a task that never waits is reported */
    delay(1);
#endif
  }
}

static void spin_0(void) { spin(0); }
static void spin_1(void) { spin(1); }

static void rest(void) {
  for (;;) {
    __asm volatile("wfi");
  }
}

static void frozen(void) {
  for (;;) {
    uint32_t before = mask();
    take(&pxCurrentTCB->xStateListItem);
    put(&xSuspendedTaskList, &pxCurrentTCB->xStateListItem);
    SCB_ICSR = PENDSVSET;
    unmask(before);
  }
}

static void filter(void) {
  for (;;) {
    filtered += 0.125f * ((float)(receive() % 1000u) - filtered);
    samples_taken++;
  }
}

static void await(volatile uint32_t *status, uint32_t bits) {
  while ((*status & bits) != bits) {
  }
}

/* Sends the address of a byte in the EEPROM, and what is to be written there. */
static void i2c_write(const uint8_t *bytes, uint32_t count) {
  I2C1_CR1 |= 1u << 8; /* START */
  await(&I2C1_SR1, 1u << 0);
  I2C1_DR = 0xA0;
  await(&I2C1_SR1, 1u << 1); /* ADDR, which reading SR2 clears */
  (void)I2C1_SR2;
  for (uint32_t i = 0; i < count; i++) {
    await(&I2C1_SR1, 1u << 7); /* TXE */
    I2C1_DR = bytes[i];
  }
  await(&I2C1_SR1, 1u << 2); /* BTF */
}

static void i2c_read_by_dma(void) {
  static const uint8_t address[2] = {0x01, 0x40};
  uint32_t before = dma_interrupts;
  i2c_write(address, 2);
  DMA_PAR(DMA1, 0) = (uint32_t)&I2C1_DR;
  DMA_M0AR(DMA1, 0) = (uint32_t)eeprom;
  DMA_NDTR(DMA1, 0) = sizeof eeprom;
  DMA_CR(DMA1, 0) = 1u << 25 | 1u << 10 | 1u << 4 | 1u; /* channel 1, memory counts up, interrupt when complete */
  I2C1_CR2 |= 1u << 12 | 1u << 11;                      /* LAST, DMAEN */
  I2C1_CR1 |= 1u << 10 | 1u << 8;                       /* ACK, START */
  await(&I2C1_SR1, 1u << 0);
  I2C1_DR = 0xA1;
  await(&I2C1_SR1, 1u << 1);
  (void)I2C1_SR2;
  while (dma_interrupts == before) {
    delay(1);
  }
  i2c_reads++;
}

__attribute__((noinline)) static void send_line(void) {
  static char line[] = "tick 00000000\n";
  uint32_t value = xTickCount;
  for (uint32_t i = 12; i > 4; i--, value >>= 4) {
    line[i] = "0123456789abcdef"[value & 15];
  }
  DMA_HIFCR(DMA2) = 0x3Du << 22;
  DMA_PAR(DMA2, 7) = (uint32_t)&USART6_DR;
  DMA_M0AR(DMA2, 7) = outbox_size ? (uint32_t)outbox : (uint32_t)line;
  DMA_NDTR(DMA2, 7) = outbox_size ? outbox_size : sizeof line - 1;
  DMA_CR(DMA2, 7) = 5u << 25 | 1u << 10 | 1u << 6 | 1u; /* channel 5, memory counts up, to the peripheral */
  outbox_size = 0;
  lines_sent++;
}

#ifndef PLANTED /* goes wrong so, from this tick on */
#define PLANTED NOTHING
#define PLANTED_TICK 0
#endif

static void (*volatile nobody)(void);
static volatile uint32_t *volatile nowhere;
static volatile uint32_t zero, wasted;

static void nothing(uint32_t how) {
  (void)how;
}

static struct {
  volatile uint32_t samples[4];
  void (*volatile done)(uint32_t how); /* not as `nobody`: a compiler would make one call of both */
} box = {.done = nothing};

/* Overwrites what follows the samples, once; it is called 300 ms later. */
__attribute__((noinline)) static void store(volatile uint32_t *samples, uint32_t count) {
  for (uint32_t i = 0; i < count; i++) {
    samples[i] = 0;
  }
}

__attribute__((noinline)) static uint32_t dig(uint32_t depth) {
  volatile uint32_t hole[16];
  hole[depth % 16] = depth;
  return depth ? dig(depth - 1) + hole[depth % 16] : hole[0];
}

__attribute__((noinline)) static void hang(void) {
  for (;;) {
    wasted++;
  }
}

/* Writes the last word of a stack, and is back, within one block of instructions. */
__attribute__((naked, noinline)) static void touch(__attribute__((unused)) uint32_t *end_of_stack) {
  __asm volatile("mov r1, sp\n mov sp, r0\n str r1, [sp]\n mov sp, r1\n bx lr");
}

__attribute__((noinline)) static void check_last(uint32_t how) {
  assert_that(how != LAST_CALL);
}

__attribute__((noinline)) static uint32_t go_wrong(uint32_t how) {
  switch (how) {
    case NULL_CALL:
      nobody();
      break;
    case NULL_READ:
      return nowhere[2];
    case NULL_WRITE:
      nowhere[3] = 1;
      break;
    case DIVISION:
      return 7 / zero;
    case HANG:
      hang();
      break;
    case WILD_WRITE:
      if (box.samples[0]) {
        store(box.samples, LENGTH(box.samples) + 1);
      }
      if (xTickCount > PLANTED_TICK + 300) {
        box.done(how);
      }
      break;
    case OVERFLOW:
      return dig(20);
    case BRIEF_OVERFLOW:
      touch(pxCurrentTCB->pxStack);
      break;
    case UNALIGNED:
      __asm volatile("vldr s0, [%0]" ::"r"(&eeprom[1]) : "s0", "memory");
      break;
    case BREAKPOINT:
      __asm volatile("bkpt #0");
      break;
    case MASKED_CALL:
      __asm volatile("cpsid i\n svc #0\n nop");
      break;
    case LAST_CALL:
      check_last(how);
      break;
    case BUS_FAULT:
      return REGISTER(0x30000000); /* nothing is there */
    case UNDEFINED:
      __asm volatile("udf #7");
      break;
    case ASSERTION:
      assert_that(how != ASSERTION);
      break;
    case MUTEX:
      lock_bus();
      break;
    case SUSPENDED:
      leave_for(&xSuspendedTaskList);
      break;
    case DELAYED:
      delay(0x7FFFFFFF);
      break;
    case DELETED:
      leave_for(&xTasksWaitingTermination);
  }
  return 0;
}

static void report(void) {
  static const uint8_t written[6] = {0x01, 0x40, 0xF1, 0x0A, 0x77, 0x1E};
  i2c_write(written, sizeof written);
  I2C1_CR1 |= 1u << 9; /* STOP */
  delay(10);           /* the EEPROM writes */
  for (;;) {
    i2c_read_by_dma();
    send_line();
    send_frame();
    TIM_CCR1(TIM3) = 1000 + xTickCount % 1000;
    if (planted != HUNGRY_WATCHDOG) {
      IWDG_KR = 0xAAAA;
    }
    if (PLANTED_TICK && xTickCount > PLANTED_TICK && !planted) {
      planted = PLANTED;
      box.samples[0] = 1;
    }
    eeprom[0] ^= (uint8_t)go_wrong(planted);
    delay(10);
  }
}

static void start(uint32_t number, const char *name, void (*run)(void), uint32_t priority) {
  TCB_t *task = &tasks[number];
  for (uint32_t i = 0; i < STACK_WORDS; i++) {
    stacks[number][i] = 0xA5A5A5A5;
  }
  uint32_t *top = &stacks[number][STACK_WORDS];
  *--top = 1u << 24;       /* xPSR: Thumb */
  *--top = (uint32_t)run;  /* pc */
  top -= 6;                /* lr, r12, r3 to r0 */
  *--top = 0xFFFFFFFD;     /* to thread mode, process stack, no FP frame */
  top -= 8;                /* r11 to r4 */
  task->pxTopOfStack = top;
  task->pxStack = stacks[number];
  task->uxPriority = task->uxBasePriority = priority;
  task->xStateListItem.pvOwner = task->xEventListItem.pvOwner = task;
  for (uint32_t i = 0; i < sizeof task->pcTaskName - 1 && name[i]; i++) {
    task->pcTaskName[i] = name[i];
  }
  put(&pxReadyTasksLists[priority], &task->xStateListItem);
  uxCurrentNumberOfTasks++;
}

/* 168 MHz from the crystal of 8 MHz, 42 and 84 MHz for the peripherals. */
static void set_up_clocks(void) {
  RCC_CR |= 1u << 16;
  await(&RCC_CR, 1u << 17);
  RCC_PLLCFGR = 7u << 24 | 1u << 22 | 336u << 6 | 8u;
  RCC_CR |= 1u << 24;
  await(&RCC_CR, 1u << 25);
  FLASH_ACR = 7u << 8 | 5u; /* caches, prefetch, five wait states */
  RCC_CFGR = 4u << 13 | 5u << 10 | 2u;
  await(&RCC_CFGR, 2u << 2);
}

static void set_up_peripherals(void) {
  RCC_AHB1ENR |= 1u << 22 | 1u << 21 | 1u << 2 | 1u << 1; /* DMA2, DMA1, GPIOC, GPIOB */
  RCC_APB1ENR |= 1u << 21 | 1u << 5 | 1u << 1 | 1u;       /* I2C1, TIM7, TIM3, TIM2 */
  RCC_APB2ENR |= 1u << 14 | 1u << 5;                      /* SYSCFG, USART6 */
  GPIO_MODER(1) |= 2u << 14 | 2u << 12;                   /* PB6, PB7: I2C1 */
  GPIO_AFRL(1) |= 4u << 28 | 4u << 24;
  GPIO_MODER(2) |= 2u << 14 | 2u << 12; /* PC6, PC7: USART6 */
  GPIO_AFRL(2) |= 8u << 28 | 8u << 24;

  TIM_PSC(TIM7) = 83; /* microseconds */
  TIM_ARR(TIM7) = 0xFFFF;
  TIM_EGR(TIM7) = 1;
  TIM_CR1(TIM7) = 1;
  TIM_PSC(TIM3) = 83;
  TIM_ARR(TIM3) = 20000 - 1;
  TIM_CCMR1(TIM3) = 6u << 4;
  TIM_CCER(TIM3) = 1;
  TIM_EGR(TIM3) = 1;
  TIM_CR1(TIM3) = 1;

  I2C1_CR2 = 42;
  I2C1_CCR = 210; /* 100 kHz */
  I2C1_TRISE = 43;
  I2C1_CR1 = 1;
  USART6_BRR = 84; /* 1 MBaud */
  USART6_CR3 = 1u << 7;
  USART6_CR1 = 1u << 13 | 1u << 5 | 1u << 3 | 1u << 2; /* UE, RXNEIE, TE, RE */

  SYSCFG_EXTICR4 = 2u << 8; /* EXTI14 from port C */
  EXTI_RTSR = EXTI_IMR = 1u << 14;
  static const uint8_t irqs[] = {40, 11, 71, 17};
  for (uint32_t i = 0; i < LENGTH(irqs); i++) {
    NVIC_IPR(irqs[i]) = (uint8_t)(MASK_PRIORITY + 0x10 * i);
    NVIC_ISER(irqs[i] / 32) = 1u << irqs[i] % 32;
  }
  IWDG_KR = 0x5555;
  IWDG_PR = 3;    /* 32 kHz by 32 */
  IWDG_RLR = 200; /* 0.2 s */
  IWDG_KR = 0xCCCC;
}

void Reset_Handler(void) {
  for (uint32_t *to = data_begin, *from = data_load; to < data_end; to++, from++) {
    *to = *from;
  }
  for (uint32_t *to = bss_begin; to < bss_end; to++) {
    *to = 0;
  }
  SCB_CPACR |= 0xFu << 20; /* the FP unit */
  __asm volatile("dsb\n isb");
  set_up_clocks();
  if (scenario) {
    run_scenario(scenario);
  }
  set_up_peripherals();
  for (uint32_t i = 0; i < LENGTH(pxReadyTasksLists); i++) {
    empty(&pxReadyTasksLists[i]);
  }
  empty(&xDelayedTaskList1), empty(&xSuspendedTaskList), empty(&xPendingReadyList), empty(&waiting_for_samples);
  empty(&xTasksWaitingTermination);
  start(0, "REPORT", report, 2);
  start(1, "SPIN-0", spin_0, 1);
  start(2, "SPIN-1", spin_1, 1);
  start(3, "FILTER", filter, 3);
  start(4, "FROZEN", frozen, 3);
  start(5, "IDLE", rest, 0);
  SCB_SHPR(14) = 0xF0; /* PendSV and SysTick last of all */
  SCB_SHPR(15) = 0xF0;
  SYST_RVR = 168000 - 1;
  SYST_CVR = 0;
  SYST_CSR = 7;
  xSchedulerRunning = 1;
  SCB_ICSR = PENDSVSET;
  rest();
}

/* Tables of contents as those of a Crazyflie lie in flash. */
enum { U8 = 0x08, U16 = 0x09, F32 = 0x06, READ_ONLY = 0x40, LOG_U32 = 3, BY_FUNCTION = 0x40, BEGIN = 0x81, END = 0x80 };

static float gain = 1.5f;
static uint16_t timeout = 500;
static uint8_t revision = 7;

static void *asked(void) {
  return &gain;
}

struct log_s {
  uint8_t type;
  const char *name;
  const volatile void *address;
};

struct param_s {
  uint8_t type, extended_type;
  const char *name;
  void *address;
  void (*callback)(void);
  void *(*getter)(void);
};

__attribute__((section(".log_table"), used)) static const struct log_s log_table[] = {
    {BEGIN, "queue", 0},          {LOG_U32, "taken", &samples_taken}, {LOG_U32 | BY_FUNCTION, "asked", &samples_taken},
    {LOG_U32, "lost", &samples_lost}, {END, "queue", 0},
};

__attribute__((section(".param_table"), used)) static const struct param_s param_table[] = {
    {BEGIN, 0, "test", 0, 0, 0},         {F32, 0, "gain", &gain, 0, 0},
    {U8 | READ_ONLY, 0, "revision", &revision, 0, 0}, {END, 0, "test", 0, 0, 0},
    {BEGIN, 0, "wait", 0, 0, 0},         {U8, 0, "asked", 0, 0, asked},
    {U16, 0, "timeout", &timeout, 0, 0}, {END, 0, "wait", 0, 0, 0},
};

#ifdef DEVICE_TYPE /* of the board that it starts on, as Bitcraze's firmware has it */
__attribute__((used)) const char *platformInit(void) {
  return DEVICE_TYPE;
}
#endif

void Stuck_Handler(void) {
  for (;;) {
  }
}

void SVC_Handler(void);
void Order_Handler(void);
void Masking_Handler(void);

typedef void (*Handler)(void);
__attribute__((section(".isr_vector"), used)) static const Handler vectors[16 + 82] = {
    (Handler)main_stack_top, Reset_Handler, Stuck_Handler, Stuck_Handler, Stuck_Handler, Stuck_Handler, Stuck_Handler,
    0, 0, 0, 0, SVC_Handler, Stuck_Handler, 0, PendSV_Handler, SysTick_Handler,
    [16 + 0] = Order_Handler, [16 + 1] = Order_Handler, [16 + 2] = Masking_Handler, [16 + 3] = Order_Handler,
    [16 + 11] = DMA1_Stream0_Handler, [16 + 17] = DMA1_Stream6_Handler, [16 + 40] = EXTI15_10_Handler, [16 + 71] = USART6_Handler,
};

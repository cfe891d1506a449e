/* Small experiments with exceptions; what they saw stands in `record`, and tests compare it with ARM's manual.
 *
 * The sections of the ARMv7-M Architecture Reference Manual: B1.5.6 entry, B1.5.7 stacking, B1.5.8 return, B1.5.4 priority.
 */
#include "registers.h"

enum scenario { FRAMES = 1, MASKING, ORDER, SYSTICK, SLEEP, IT_BLOCKS, CODE_IN_RAM, MEASURED };

#define NUMBERS "0,1,2,3,4,5,6,7,8,9,10,11,12"
#define FP_NUMBERS NUMBERS ",13,14,15,16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31"

volatile uint32_t record[256], recorded, finished, ticks, ticks_in_it_blocks;
uint32_t process_stack[64] __attribute__((aligned(8)));
static volatile uint32_t nesting;
extern const char masked_until_here[], masked_until_there[]; void measured(void);

static void note(uint32_t value) { record[recorded++] = value; }

/* Notes how an exception was entered: EXC_RETURN, its number, CONTROL, both stack pointers, and the whole frame. */
__attribute__((used)) static void note_entry(uint32_t msp, uint32_t psp, uint32_t exc_return, const uint32_t *frame) {
  uint32_t number, control;
  __asm volatile("mrs %0, ipsr\n mrs %1, control" : "=r"(number), "=r"(control));
  note(exc_return), note(number), note(control), note(msp), note(psp);
  if (!(exc_return & 0x10)) {
    __asm volatile("vmov s0, s0"); /* the registers are there at the latest now (lazy stacking) */
  }
  for (uint32_t i = 0; i < (exc_return & 0x10 ? 8 : 26); i++) {
    note(frame[i]);
  }
}

__attribute__((naked)) void SVC_Handler(void) {
  __asm volatile("mov r0, sp\n mrs r1, psp\n mov r2, lr\n tst lr, #4\n ite eq\n moveq r3, r0\n movne r3, r1\n b note_entry");
}

/* Fills the registers, calls the supervisor, and notes the stack pointer before and all registers after. */
#define FRAME_EXPERIMENT(name, before, after)                                                          \
  __attribute__((naked, noinline)) static void name(__attribute__((unused)) uint32_t *registers) {    \
    __asm volatile("push {r0, r4-r11, lr}\n" before "mov r1, sp\n str r1, [r0, #72]\n"                \
                   ".irp n," NUMBERS "\n movw r\\n, #0x1100 + \\n\n .endr\n movw lr, #0x110e\n"       \
                   "mvn r12, #0\n msr apsr_nzcvq, r12\n movw r12, #0x110c\n"                               \
                   "svc #7\n"                                                                         \
                   "push {r0-r12, lr}\n mrs r1, apsr\n mov r2, sp\n add sp, #56\n mov r3, sp\n" after \
                   "ldr r0, [sp]\n str r1, [r0, #56]\n str r3, [r0, #60]\n"                           \
                   ".irp n,0,4,8,12,16,20,24,28,32,36,40,44,48,52\n"                               \
                   "ldr r1, [r2, #\\n]\n str r1, [r0, #\\n]\n .endr\n"                                \
                   "pop {r0, r4-r11, pc}");                                                           \
  }
#define NO_FP "movs r2, #0\n msr control, r2\n isb\n"
#define FILL_FP "movw r2, #0x2200\n .irp n," FP_NUMBERS "\n vmov s\\n, r2\n adds r2, #1\n .endr\n" \
                "mov r2, #0x03c00000\n vmsr fpscr, r2\n"
FRAME_EXPERIMENT(frame_aligned, NO_FP, "")
FRAME_EXPERIMENT(frame_misaligned, NO_FP "sub sp, #4\n", "add sp, #4\n")
FRAME_EXPERIMENT(frame_with_fp, FILL_FP, "")

static void copy(const volatile uint32_t *registers) {
  for (uint32_t i = 0; i < 19; i++) {
    note(registers[i]);
  }
}

static void frames(void) {
  static uint32_t registers[20];
  uint32_t fp[32];
  frame_aligned(registers), copy(registers);
  frame_misaligned(registers), copy(registers);
  __asm volatile("msr psp, %0\n isb" ::"r"(&process_stack[64]));
  __asm volatile(
      "mov r4, sp\n movs r2, #2\n msr control, r2\n isb\n mov r0, %0\n"
      "movw r3, #0x3300\n svc #8\n mov r0, sp\n movs r2, #0\n msr control, r2\n isb\n str r0, [%0, #72]\n"
      ::"r"(registers) : "r0", "r2", "r3", "r4", "lr", "memory");
  note(registers[18]);
  frame_with_fp(registers);
  __asm volatile("vstmia %0, {s0-s31}\n" ::"r"(fp) : "memory");
  copy(registers);
  for (uint32_t i = 0; i < 32; i++) {
    note(fp[i]);
  }
}

static void enable(uint32_t irq, uint8_t priority) {
  NVIC_IPR(irq) = priority;
  NVIC_ISER(0) = 1u << irq;
}

/* Notes r0 and the pc of who was interrupted. */
__attribute__((used)) static void note_interrupted(const uint32_t *frame) {
  note(frame[0]), note(frame[6]);
}

__attribute__((naked)) void Masking_Handler(void) { __asm volatile("mov r0, sp\n b note_interrupted"); }

static void masking(void) {
  enable(2, 0x60);
  __asm volatile(
      "movs r0, #0\n movs r1, #0x50\n msr basepri, r1\n isb\n"
      "movs r1, #4\n ldr r2, =0xE000E200\n str r1, [r2]\n dsb\n isb\n" /* pending, masked */
      "adds r0, #1\n movs r1, #0x70\n msr basepri_max, r1\n nop\n"      /* only ever tightens */
      "adds r0, #1\n movs r1, #0x60\n msr basepri, r1\n nop\n"          /* its own priority masks it too */
      "adds r0, #1\n movs r1, #0x70\n msr basepri, r1\n"
      ".global masked_until_here\n masked_until_here: adds r0, #1\n adds r0, #1\n"
      "movs r1, #0\n msr basepri, r1\n isb\n cpsid i\n"
      "movs r1, #4\n str r1, [r2]\n dsb\n isb\n"
      "adds r0, #1\n cpsie i\n"
      ".global masked_until_there\n masked_until_there: adds r0, #1\n adds r0, #1\n" ::: "r0", "r1", "r2", "memory");
  note((uint32_t)masked_until_here), note((uint32_t)masked_until_there);
}

/* Notes who runs, on which stack, and how it will return. */
__attribute__((used)) static void note_run(uint32_t msp, uint32_t exc_return) {
  uint32_t number;
  __asm volatile("mrs %0, ipsr" : "=r"(number));
  note(number - 16), note(msp), note(exc_return);
  if (number == 16 && nesting) {
    NVIC_ISPR(0) = 1u << 1 | 1u << 3;
    __asm volatile("dsb\n isb");
    note(100); /* after what came between */
  }
}

__attribute__((naked)) void Order_Handler(void) { __asm volatile("mov r0, sp\n mov r1, lr\n b note_run"); }

static void order(void) {
  enable(0, 0x80), enable(1, 0x40), enable(3, 0x80);
  __asm volatile("cpsid i");
  NVIC_ISPR(0) = 1u << 3 | 1u << 1 | 1u << 0;
  __asm volatile("cpsie i\n isb");
  note(200);
  nesting = 1;
  NVIC_ISPR(0) = 1u << 0;
  __asm volatile("dsb\n isb");
  note(300);
}

static uint32_t now(void) { return TIM_CNT(TIM7); }

static void start_clock(void) {
  RCC_APB1ENR |= 1u << 5;
  TIM_PSC(TIM7) = 83;
  TIM_ARR(TIM7) = 0xFFFF;
  TIM_EGR(TIM7) = 1;
  TIM_CR1(TIM7) = 1;
}

static void systick(void) {
  start_clock();
  SYST_RVR = 16800 - 1; /* 0.1 ms */
  SYST_CVR = 5;         /* any value clears it */
  note(SYST_CVR);
  SYST_CSR = 5; /* no interrupt */
  uint32_t begin = now(), wraps = 0, highest = 0;
  while (now() - begin < 10000) {
    uint32_t value = SYST_CVR;
    highest = value > highest ? value : highest;
    wraps += SYST_CSR >> 16 & 1;
  }
  note(wraps), note(highest), note(ticks);
  begin = now();
  SYST_CSR = 7;
  while (now() - begin < 10000) {
  }
  SYST_CSR = 0;
  note(ticks);
}

static void sleep(void) {
  start_clock();
  SYST_RVR = 168000 - 1;
  SYST_CVR = 0;
  uint32_t begin = now();
  SYST_CSR = 7;
  __asm volatile("cpsid i\n wfi");
  note(now() - begin), note(ticks); /* woken, but masked */
  __asm volatile("cpsie i\n isb");
  note(ticks);
  __asm volatile("wfi");
  note(now() - begin), note(ticks);
  SYST_CSR = 0;
}

/* Called by SysTick: spoils the flags, as any handler does. */
__attribute__((used)) static void count_tick(const uint32_t *frame) {
  ticks++;
  ticks_in_it_blocks += (frame[7] & 0x0600FC00) != 0; /* xPSR's IT[7:0] */
  __asm volatile("cmp %0, #0\n ite ne\n movne r3, #1\n moveq r3, #2" ::"r"(ticks & 1) : "r3", "cc");
}

__attribute__((naked)) void Scenario_SysTick(void) { __asm volatile("mov r0, sp\n b count_tick"); }

static void it_blocks(void) {
  SYST_RVR = 997;
  SYST_CVR = 0;
  SYST_CSR = 7;
  __asm volatile(
      "movs r0, #0\n movs r1, #0\n movs r2, #0\n movs r3, #0\n movw r4, #20000\n"
      "1: cmp r4, r4\n itete eq\n addeq r0, #1\n addne r1, #1\n addeq r2, #1\n addne r3, #1\n"
      "cmp r4, #0\n itete eq\n addeq r1, #1\n addne r0, #1\n addeq r3, #1\n addne r2, #1\n"
      "subs r4, #1\n bne 1b\n"
      "ldr r4, =record\n stmia r4, {r0-r3}\n" ::: "r0", "r1", "r2", "r3", "r4", "memory", "cc");
  SYST_CSR = 0;
  recorded = 4;
  note(ticks), note(ticks_in_it_blocks);
}

/* Calls `movs r0, #n; bx lr` from RAM, where n changes between the calls, beside data in the same page. */
static void code_in_ram(void) {
  static volatile uint16_t code[8] __attribute__((aligned(16)));
  uint32_t (*call)(void) = (uint32_t(*)(void))((uint32_t)code | 1);
  code[1] = 0x4770;
  for (uint32_t n = 0; n < 6; n++) {
    code[0] = 0x2000 | n;
    __asm volatile("dsb\n isb" ::: "memory");
    note(call());
    code[7] = n;
    note(call());
  }
}

void run_scenario(uint32_t number) {
  static void (*const scenarios[])(void) = {
      [FRAMES] = frames, [MASKING] = masking, [ORDER] = order, [SYSTICK] = systick, [SLEEP] = sleep, [IT_BLOCKS] = it_blocks,
      [CODE_IN_RAM] = code_in_ram, [MEASURED] = measured,
  };
  scenarios[number]();
  finished = 1;
  for (;;) {
    __asm volatile("nop");
  }
}

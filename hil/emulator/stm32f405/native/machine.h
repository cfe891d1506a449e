/* The STM32F405 around the instruction emulator unicorn: what all parts of the machine share.

Time counts in cycles of the 168 MHz core clock since power-on. A part plans its next action in its slot of `due`; a part
whose interrupt request changes calls `set_line`. Code runs by basic blocks; between them due actions run, exceptions are
entered, and the machine stops when the caller must act. Chapters refer to ST's reference manual RM0090, B1 to ARM's
ARMv7-M Architecture Reference Manual.

Python reads this file as well (chip.py): layouts, prototypes and numbers are declared only here. It ignores lines that
begin with #. */
#ifndef MACHINE_H
#define MACHINE_H

#include <stdint.h>

enum {
    CLOCK_HZ = 168000000,
    FLASH_BASE = 0x08000000, FLASH_SIZE = 0x100000, FLASH_LINE = 16, FLASH_LINES = FLASH_SIZE / FLASH_LINE,
    RAM_BASE = 0x20000000, RAM_SIZE = 0x20000,
    CCM_BASE = 0x10000000, CCM_SIZE = 0x10000,
    PERIPHERALS_SIZE = 0x80000, PAGE_SIZE = 1024, /* unicorn's pages of memory */
    TIMERS = 14, BUSES = 3, SPIS = 3, USARTS = 6, PORTS = 9, DMAS = 2, STREAMS = 8,
    EXCEPTIONS = 128, IRQ = 16, /* exception number of interrupt 0 */
    DEVICES = 16, ESCS = 4, BREAKPOINTS = 64, LOW_WRITERS = 16, WATCHPOINTS = 8, LINE_BYTES = 4096, TASKS = 32, SWITCHES = 4096,
};

/* Of a profile. A node whose function is ROOT + n is the root of a task below TASKS, of what runs before all tasks at TASKS, of
   exception n - TASKS - 1 above. STACKS: those of tasks, of the start, of nested exceptions. A bin is an eighth of an octave. */
enum {
    NODES = 1 << 16, FRAMES = 64, LEVELS = 16, STACKS = TASKS + 1 + LEVELS, ROOTS = TASKS + 1 + EXCEPTIONS, ROOT = 1 << 16,
    TOUCHED = 1024, ACTIVATIONS = 1 << 20, BINS = 256,
};

/* Sums in one number, from these bits on: cycles, instructions, those that may write BASEPRI or FAULTMASK, and those that
   may lower a stack pointer. A block has at most one of the third, at its end, and few of the fourth. */
enum { SUM_CYCLES = 0, SUM_INSTRUCTIONS = 28, SUM_MASKS = 48, SUM_STACKERS = 50 };

/* Exceptions, B1.5.2. */
enum { RESET = 1, NMI, HARD_FAULT, MEMORY_FAULT, BUS_FAULT, USAGE_FAULT, SVC = 11, PENDSV = 14, SYSTICK };

/* Slots of `due`. */
enum {
    DUE_SYSTICK,
    DUE_TIMER,
    DUE_BUS = DUE_TIMER + TIMERS,
    DUE_SPI = DUE_BUS + BUSES,
    DUE_SEND = DUE_SPI + SPIS,
    DUE_RECEIVE = DUE_SEND + USARTS,
    DUE_WATCHDOG = DUE_RECEIVE + USARTS,
    DUE_ESC,
    SLOTS = DUE_ESC + ESCS,
};

/* Why a run stopped before its time. */
enum {
    STOP_SERIAL = 1, STOP_COMPARE = 2, STOP_RESET = 4, STOP_WATCHDOG = 8, STOP_BREAK = 16, STOP_LOCKUP = 32, STOP_STEP = 64,
    STOP_OVERFLOW = 128, STOP_LOW_READ = 256, STOP_DIVISION = 512, STOP_WATCHPOINT = 1024,
    STOP_LOW_WRITE = 2048, STOP_DEVICE = 4096,
};

/* Registers by unicorn's numbers. */
enum {
    R_FLAGS = 2, R_FPSCR = 6, R_LR = 10, R_PC = 11, R_SP = 12, R_D0 = 14, R_R0 = 66, R_R12 = 78, R_MSP = 115, R_PSP = 116, R_CONTROL = 117,
    R_XPSR = 120, R_PRIMASK = 123, THUMB = 1 << 24, /* the last is a bit of XPSR */
};

/* Errors of unicorn. */
enum { READ_UNMAPPED = 6, WRITE_UNMAPPED, FETCH_UNMAPPED, INVALID = 10, WRITE_PROTECTED = 12, FETCH_PROTECTED = 14 };

/* Bits of CFSR and CCR, B3.2. */
enum {
    IACCVIOL = 1, IBUSERR = 1 << 8, PRECISERR = 1 << 9, BFARVALID = 1 << 15, UNDEFINSTR = 1 << 16, INVSTATE = 1 << 17,
    INVPC = 1 << 18, NOCP = 1 << 19, UNALIGNED = 1 << 24, DIVBYZERO = 1 << 25, UNALIGN_TRP = 8, DIV_0_TRP = 16,
};
enum { IT_STATE = 0x0600FC00 };                /* bits of XPSR, B1.4.2 */

#define NEVER UINT64_MAX

typedef struct uc_engine uc_engine;
typedef uint64_t (*read_call)(uc_engine *, uint64_t, unsigned, void *);
typedef void (*write_call)(uc_engine *, uint64_t, unsigned, uint64_t, void *);

/* Functions of libunicorn, loaded before this library. */
struct engine {
    uc_engine *uc;
    int (*reg_read)(uc_engine *, int, void *);
    int (*reg_write)(uc_engine *, int, const void *);
    int (*emu_start)(uc_engine *, uint64_t, uint64_t, uint64_t, uint64_t);
    int (*emu_stop)(uc_engine *);
    int (*mmio_map)(uc_engine *, uint64_t, uint64_t, read_call, void *, write_call, void *);
    int (*hook_add)(uc_engine *, uint64_t *, int, void *, void *, uint64_t, uint64_t, ...);
    int (*hook_del)(uc_engine *, uint64_t);
    int (*ctl)(uc_engine *, uint32_t, ...);
    int (*mem_read)(uc_engine *, uint64_t, void *, uint64_t);
    int (*mem_write)(uc_engine *, uint64_t, const void *, uint64_t);
};

struct timer {
    uint64_t since; /* when the counter was `base` */
    uint64_t seen;  /* overflows that have set the flag already */
    uint32_t base, cr1, dier, sr, psc, arr, prescaler; /* `prescaler`: in effect since the last update */
    uint32_t others[32];
};

struct device { /* a memory as a device on I2C or SPI: registers, or an EEPROM */
    uint8_t *memory;
    uint32_t size, pointer, address_bytes, left; /* `left`: missing bytes of the address */
    uint32_t bus, address, writes, pairs; /* `pairs`: every written byte follows its own address */
    /* On SPI `bus` is BUSES + n, and `address` the pin that selects it, 16 port + number. */
    uint32_t selected, reading, first; /* `first`: first byte of a transfer on SPI: address and direction */
    uint32_t watched, wrote;           /* `watched`: the outside acts on what is written */
    uint8_t burst[256]; /* the data of a read in progress */
};

struct esc { /* of a motor, at a timer's output */
    const double *rpm;
    uint32_t timer, channel, poles;
    uint32_t bits, frame, refused, throttle; /* `refused`: frames with a wrong checksum */
    uint32_t ready;                          /* a zero has arrived since the last silence: it may start */
    uint32_t reply, left, high;              /* the reply, how many bits of it have yet to leave, and the level */
    uint64_t reply_bit;                      /* [cycles] */
};

/* The registers of these three by name, and by their offset over 4. */
struct bus {
    union {
        struct { uint32_t cr1, cr2, oar1, oar2, dr, sr1, sr2, ccr, trise, fltr; };
        uint32_t registers[10];
    };
    uint32_t shift, action, holding;
    struct device *device;
};

struct spi {
    union {
        struct { uint32_t cr1, cr2, sr, dr, others[6]; };
        uint32_t registers[10];
    };
    uint32_t held, shift, busy;
};

struct usart {
    union {
        struct { uint32_t sr, dr, brr, cr1, cr2, cr3, gtpr; };
        uint32_t registers[7];
    };
    uint32_t held, shift, sending, overruns;
    uint8_t received[LINE_BYTES], sent[LINE_BYTES];
    uint32_t first, last, filled; /* of `received`, a ring; of `sent` */
};

struct stream {
    uint32_t cr, ndtr, par, m0ar, m1ar, fcr, initial, place;
};

struct dma {
    uint32_t flags[2];
    struct stream stream[STREAMS];
};

struct task { /* by its control block: cycles of processor time, including interrupts */
    uint64_t cycles, busy_since; /* since when it has not waited; 0: it waits */
    uint64_t ran;                /* when it last stopped running */
    uint32_t block, times;
};

struct kernel { /* of FreeRTOS: places of members and lists; 0: unknown */
    uint32_t current_place; /* address of the pointer to the running task's control block */
    uint32_t stack_offset, container_offset; /* in a control block: its stack's begin, the list that it is in */
    uint32_t ready_begin, ready_end; /* the lists of ready tasks */
};

struct watchpoint { /* memory whose access stops for a debugger */
    struct machine *machine;
    uint64_t hook; /* 0: free */
    uint32_t address, size, kind;
};

struct passage { /* of a half word of flash: blocks that begin there, and that end before it: going on there, or elsewhere */
    uint64_t begun, fell, jumped;
};

struct node { /* of the tree of calls; `site`: after the call, offset in flash; `recent`: in its task's activation */
    uint64_t cycles, asleep, recent, activation;
    uint32_t function, site, parent, child, sibling, calls;
};

struct frame {
    uint32_t node, back;
};

struct calls {
    uint32_t depth;
    struct frame frame[FRAMES];
};

struct activation { /* of a task, from its first instruction after a wait to the next wait */
    uint64_t begin, end, cycles, task; /* `cycles`: those it executed itself, without interrupts and sleep */
};

struct activity { /* the activation of a task that has not ended; `others`: totals of all at its begin */
    uint64_t number, begin, cycles, others[ROOTS];
    uint32_t touched, node[TOUCHED];
};

struct worst { /* the longest activation of a task: its nodes, and what all took meanwhile */
    uint64_t begin, end, cycles, recent[TOUCHED], others[ROOTS];
    uint32_t count, node[TOUCHED];
};

struct handler {
    uint64_t begin, nested;
    uint32_t exception;
};

struct service { /* of an exception, without those that interrupt it */
    uint64_t count, cycles, worst, when;
    uint32_t bin[BINS];
};

struct masked {
    uint64_t cycles, when;
    uint32_t begin, end, root; /* places: offsets in flash */
};

struct profile {
    uint64_t since, taken, slept, lost, activations, logged, total[ROOTS]; /* `lost`: calls and activations without room */
    uint32_t at, root, function, back, last, level, nodes;
    uint64_t masked_since[2];
    uint32_t masked_at[2];
    struct masked masked[2];
    struct handler handler[LEVELS + 1];
    struct calls calls[STACKS];
    struct activity activity[TASKS + 1];
    struct worst worst[TASKS + 1];
    struct service service[EXCEPTIONS];
    uint16_t functions[FLASH_SIZE / 2]; /* around each half word: its number, with the highest bit where it begins; 0: none */
    struct node node[NODES];
    struct activation log[ACTIVATIONS];
};

struct task_switch {
    uint64_t now;
    uint32_t block;
};

struct flash_line { /* its neighbours in the order of their last use; FLASH_LINES on both sides of all lines */
    uint32_t newer, older, cached;
};

struct flash_cache {
    uint32_t filled;
    struct flash_line lines[FLASH_LINES + 1];
};

struct machine {
    uint64_t now, instructions, exceptions, sleeping; /* `sleeping`: cycles spent in WFI */
    uint64_t begun, begun_at;    /* instructions and cycles before the block that was begun last */
    uint64_t earlier_at;         /* cycles before the block before it */
    uint64_t next_due;
    uint32_t pc, stop_reason, asleep, watchdog_on;
    uint32_t fault_address, unknown_count;
    uint32_t unknown[16]; /* peripherals that were used: not modelled, or with 1 added those without a clock */
    uint64_t owed, taken; /* cycles that an outside load takes before all tasks, but not before interrupts; has taken */
    uint32_t tracing, task_count, switch_count;
    struct kernel kernel;
    uint64_t running_since;
    struct task task[TASKS]; /* the running one is `task[running]` */
    uint32_t running, locked;
    uint32_t resume;  /* where to resume inside a block that was counted as a whole */
    uint32_t skip_at; /* the breakpoint at which the last run stopped */
    uint32_t stack_begin; /* of the running task, 0: unknown */
    uint32_t overflow;    /* the task whose stack has overflowed first since the reset, 0: none */
    uint32_t divided;     /* a division by zero was reported */
    uint32_t watch_address, watch_pc; /* the last access of a watchpoint, and its instruction */
    uint64_t watch_exceptions;        /* how many exceptions had been entered then */
    uint32_t task_return;   /* EXC_RETURN of the last exception that has interrupted a task */
    struct task_switch task_switch[SWITCHES];
    struct engine engine;
    uint64_t until, due[SLOTS];
    uint64_t *before; /* sums of `SUM_...` over instructions before each half word of flash */
    uint32_t stacks;  /* whether the last block may lower a stack pointer */
    uint32_t recorded; /* whether there are passages or a profile */
    uint32_t masks;   /* whether the last block may end with a write to BASEPRI or FAULTMASK */
    uint64_t next_address;
    struct flash_cache *flash_cache; /* 0: flash keeps up with the core */
    struct profile *profile;  /* 0: not recorded */
    struct passage *passages; /* of all half words of flash and one more, 0: not recorded */
    uint32_t block_begin, block_end; /* of the recorded block that has not ended, equal without one; offsets in flash */
    uint8_t *flash, *ram, *ccm;
    uint8_t executed[RAM_SIZE / PAGE_SIZE]; /* pages of RAM from which code was executed */
    uint32_t stopping, attention, fault, stepping, first_step;
    uint64_t break_hook[BREAKPOINTS];
    uint32_t break_address[BREAKPOINTS];
    struct watchpoint watchpoint[WATCHPOINTS];
    uint32_t low_writers[LOW_WRITERS], low_writer_count; /* reported instructions */
    uint64_t float_hook; /* while the floating-point unit is off */
    uint32_t canary; /* the last word of the running task's stack was unused when it got the processor */

    uint32_t input[PORTS];
    struct device device[DEVICES];
    struct esc esc[ESCS];
    uint32_t escs;
    uint32_t devices, touched; /* `touched`: bits of the watched ones that the outside has not looked at since */

    /* From here on a reset clears everything. Exceptions: */
    uint64_t enabled[2], pending[2], active[2], line[2];
    uint8_t priority[EXCEPTIONS];
    uint32_t vtor, aircr, shcsr, cfsr, hfsr, bfar, scr, ccr, cpacr, fpccr;
    uint32_t basepri, faultmask; /* unicorn's own have no effect: see alignment.c */

    uint32_t tick_ctrl, tick_load;
    uint64_t tick_since;
    uint32_t exti[6]; /* IMR EMR RTSR FTSR SWIER PR */
    uint32_t output[PORTS], compare[TIMERS][4]; /* `compare`: an ESC's throttle where there is one */
    uint32_t watchdog_prescaler, watchdog_reload, random;
    struct timer timer[TIMERS];
    struct bus bus[BUSES];
    struct spi spi[SPIS];
    struct usart usart[USARTS];
    struct dma dma[DMAS];
    uint32_t plain[PERIPHERALS_SIZE / 4]; /* registers that only store values */
};

/* Called by Python. */
uint64_t machine_size(void);
int machine_attach(struct machine *m, const struct engine *engine, uint8_t *flash, uint8_t *ram, uint8_t *ccm,
                   uint64_t *before);
int machine_device(struct machine *m, uint32_t bus, uint32_t address, uint8_t *memory, uint32_t size, uint32_t address_bytes,
                   uint32_t pairs);
int machine_esc(struct machine *m, uint32_t timer, uint32_t channel, const double *rpm, uint32_t poles);
void machine_reset(struct machine *m, uint32_t vectors, uint32_t cause);
uint32_t machine_run(struct machine *m, uint64_t until);
uint32_t machine_step(struct machine *m, uint64_t until);
int machine_break(struct machine *m, uint32_t address, int on);
int machine_watch(struct machine *m, uint32_t kind, uint32_t address, uint32_t size, int on);
uint32_t machine_sent(struct machine *m, uint32_t n, uint8_t *bytes);
void flash_empty(struct machine *m);
void profile_reset(struct machine *m);
void profile_settle(struct machine *m);
void machine_pin(struct machine *m, uint32_t port, uint32_t pin, uint32_t high);
uint32_t usart_feed(struct machine *m, unsigned n, const uint8_t *bytes, uint32_t size);

/* exceptions.c */
uint32_t get_register(struct machine *m, int number);
uint32_t get_core_register(struct machine *m, unsigned number);
void set_core_register(struct machine *m, unsigned number, uint32_t value);
uint8_t *memory_at(struct machine *m, uint32_t address, uint32_t size);
void set_register(struct machine *m, int number, uint32_t value);
void set_xpsr(struct machine *m, uint32_t value);
void set_line(struct machine *m, unsigned irq, int high);
void set_pending(struct machine *m, unsigned exception);
unsigned next_exception(struct machine *m, int waking);
void enter(struct machine *m, unsigned exception, uint32_t return_address);
void leave(struct machine *m, uint32_t exc_return);
void note_overflow(struct machine *m);
void call_supervisor(struct machine *m, uint32_t return_address);
void raise_fault(struct machine *m, unsigned exception, uint32_t status, uint32_t pc);
uint64_t system_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void system_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);

void tick_due(struct machine *m);

/* flash.c: `begin` and `end` count from the begin of flash */
void read_flash(struct machine *m, uint32_t begin, uint32_t end);

/* alignment.c */
void on_unaligned(struct machine *m, uint32_t pc);
void set_masks(struct machine *m);
int watch_alignment(struct machine *m);

/* machine.c */
void stop(struct machine *m, uint32_t pc);
void cut_block(struct machine *m, uint32_t pc);
void fault_of(struct machine *m, int error);
void note_access(struct watchpoint *w, uint32_t first, uint32_t size);
void plan(struct machine *m, unsigned slot, uint64_t due);

/* profile.c */
void profile_block(struct machine *m, uint32_t at, uint32_t end);
void profile_enter(struct machine *m, unsigned exception);
void profile_leave(struct machine *m, uint64_t now);
void profile_resume(struct machine *m);
void end_activation(struct machine *m);

/* timers.c */
uint32_t timer_read(struct machine *m, unsigned n, uint32_t offset);
void timer_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void timer_due(struct machine *m, unsigned n);
void timer_edge(struct machine *m, unsigned n, unsigned channel, int high, uint64_t when);

/* esc.c */
struct esc *esc_at(struct machine *m, unsigned timer, unsigned channel);
void esc_pulse(struct machine *m, struct esc *e, uint64_t width, uint64_t period, uint64_t tick, int inverted);
void esc_due(struct machine *m, unsigned i);

/* i2c.c, spi.c, usart.c */
uint32_t bus_read(struct machine *m, unsigned n, uint32_t offset);
void bus_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void bus_due(struct machine *m, unsigned n);
void device_write(struct device *d, uint8_t byte);
void device_begin(struct device *d, int reading);
uint8_t device_read(struct device *d);
void device_end(struct machine *m, struct device *d);
uint32_t spi_read(struct machine *m, unsigned n, uint32_t offset);
void spi_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void spi_due(struct machine *m, unsigned n);
void spi_kick(struct machine *m);
void spi_select(struct machine *m, unsigned port, uint32_t levels);
uint32_t usart_read(struct machine *m, unsigned n, uint32_t offset);
void usart_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void usart_send_due(struct machine *m, unsigned n);
void usart_receive_due(struct machine *m, unsigned n);
void usart_kick(struct machine *m);

/* dma.c */
uint32_t dma_read(struct machine *m, unsigned n, uint32_t offset);
void dma_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
int dma_put(struct machine *m, uint32_t peripheral, uint32_t item, int *last);
int dma_take(struct machine *m, uint32_t peripheral, uint32_t *item);

/* peripherals.c */
void note_unknown(struct machine *m, uint32_t address);
uint64_t ram_bit_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void ram_bit_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);
uint64_t peripheral_bit_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void peripheral_bit_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);
uint64_t peripheral_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void peripheral_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);
uint64_t usb_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void usb_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);

#endif

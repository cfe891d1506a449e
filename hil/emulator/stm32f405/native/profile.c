/* Where the cycles go: a tree of calls for every task and every exception, and how long their activations take.

Every cycle of the machine's time is charged to one node of the tree. A function is entered by a call instruction at its
first instruction, and left at the address after the call. A jump to another function takes the place of the one that
jumps. A task keeps its stack of calls while others run; an exception begins with an empty one. */
#include "machine.h"

#include <string.h>

enum { LOOK_DOWN = 16, FIRST_INSTRUCTION = 0x8000, NO_RETURN = 1 };

static struct calls *running_calls(struct machine *m)
{
    struct profile *p = m->profile;
    return &p->calls[p->level ? TASKS + p->level : m->task_count ? m->running : TASKS];
}

/* Return the child of a node for a function that is called from a place; a full tree keeps the node itself. */
static uint32_t child_of(struct profile *p, uint32_t parent, uint32_t function, uint32_t site)
{
    uint32_t *link = &p->node[parent].child, before = 0;
    for (uint32_t i = *link; i; before = i, i = p->node[i].sibling)
        if (p->node[i].function == function && p->node[i].site == site) {
            if (before) { /* it will soon be looked for again */
                p->node[before].sibling = p->node[i].sibling;
                p->node[i].sibling = *link;
                *link = i;
            }
            return i;
        }
    if (p->nodes == NODES) {
        p->lost++;
        return parent;
    }
    uint32_t made = p->nodes++;
    p->node[made] = (struct node){.parent = parent, .function = function, .site = site, .sibling = *link};
    *link = made;
    return made;
}

/* Charge the time up to an instant to the running function. */
static void charge(struct machine *m, uint64_t now)
{
    struct profile *p = m->profile;
    uint64_t taken = m->taken - p->taken, cycles = now - p->since - taken, asleep = m->sleeping - p->slept;
    struct node *node = &p->node[p->at];
    p->since = now;
    p->taken = m->taken;
    p->slept = m->sleeping;
    node->cycles += cycles;
    node->asleep += asleep;
    p->total[p->root] += cycles;
    if (p->root > TASKS)
        return;
    struct activity *a = &p->activity[p->root];
    if (node->activation != a->number) {
        node->activation = a->number;
        node->recent = 0;
        if (a->touched < TOUCHED)
            a->node[a->touched++] = p->at;
    }
    node->recent += cycles - asleep;
    a->cycles += cycles - asleep;
}

static void look_at_calls(struct machine *m)
{
    struct profile *p = m->profile;
    struct calls *calls = running_calls(m);
    p->at = calls->frame[calls->depth].node;
    p->back = calls->frame[calls->depth].back;
    p->function = p->node[p->at].function;
}

/* Continue with the running task, or with the exception that was entered last. */
static void look_at_context(struct machine *m, unsigned root)
{
    struct profile *p = m->profile;
    struct calls *calls = running_calls(m);
    p->root = root;
    p->last = 0;
    if (!calls->depth)
        calls->frame[0] = (struct frame){.node = child_of(p, 0, ROOT + root, 0), .back = NO_RETURN};
    look_at_calls(m);
}

static void begin_activation(struct machine *m, struct activity *a)
{
    struct profile *p = m->profile;
    a->number = ++p->activations;
    a->begin = m->now;
    a->cycles = a->touched = 0;
    memcpy(a->others, p->total, sizeof a->others);
}

/* The running task waits now. */
void end_activation(struct machine *m)
{
    struct profile *p = m->profile;
    charge(m, m->now);
    struct activity *a = &p->activity[m->running];
    if (!a->number)
        return;
    struct worst *w = &p->worst[m->running];
    if (m->now - a->begin > w->end - w->begin) {
        w->begin = a->begin;
        w->end = m->now;
        w->cycles = a->cycles;
        w->count = a->touched;
        for (uint32_t i = 0; i < a->touched; i++) {
            w->node[i] = a->node[i];
            w->recent[i] = p->node[a->node[i]].recent;
        }
        for (unsigned i = 0; i < ROOTS; i++)
            w->others[i] = p->total[i] - a->others[i];
    }
    if (p->logged < ACTIVATIONS)
        p->log[p->logged++] = (struct activation){.begin = a->begin, .end = m->now, .cycles = a->cycles, .task = m->running};
    else
        p->lost++;
    a->number = 0;
}

/* Record how long interrupts stay masked: 0 by PRIMASK or FAULTMASK, 1 by BASEPRI. */
static void look_at_mask(struct machine *m, unsigned kind, int on, uint32_t place)
{
    struct profile *p = m->profile;
    if (on && !p->masked_since[kind]) {
        p->masked_since[kind] = m->now;
        p->masked_at[kind] = place;
    } else if (!on && p->masked_since[kind]) {
        struct masked *w = &p->masked[kind];
        if (m->now - p->masked_since[kind] > w->cycles)
            *w = (struct masked){.cycles = m->now - p->masked_since[kind], .when = p->masked_since[kind],
                                 .begin = p->masked_at[kind], .end = place, .root = p->root};
        p->masked_since[kind] = 0;
    }
}

static uint16_t half_word(const struct machine *m, uint32_t at)
{
    uint16_t value;
    memcpy(&value, m->flash + (at & (FLASH_SIZE - 2)), sizeof value);
    return value;
}

/* The last block may have ended with CPS or MSR. */
static void look_at_masks(struct machine *m)
{
    uint32_t last = m->profile->last;
    if (!last)
        return;
    uint16_t before = half_word(m, last - 2);
    if ((before & 0xFFE8) == 0xB660 || ((before & 0xFF00) == 0x8800 && (half_word(m, last - 4) & 0xFFF0) == 0xF380)) {
        look_at_mask(m, 0, (get_register(m, R_PRIMASK) & 1) || m->faultmask, last);
        look_at_mask(m, 1, m->basepri != 0, last);
    }
}

/* An exception begins; its entry is part of it. */
void profile_enter(struct machine *m, unsigned exception)
{
    struct profile *p = m->profile;
    look_at_masks(m);
    charge(m, m->now);
    if (p->level < LEVELS)
        p->level++;
    p->handler[p->level] = (struct handler){.exception = exception, .begin = m->now};
    running_calls(m)->depth = 0;
    look_at_context(m, TASKS + 1 + exception);
}

/* It ends at an instant. */
void profile_leave(struct machine *m, uint64_t now)
{
    struct profile *p = m->profile;
    charge(m, now);
    if (!p->level)
        return;
    struct handler *h = &p->handler[p->level--];
    uint64_t whole = now - h->begin, own = whole - h->nested;
    p->handler[p->level].nested += whole;
    struct service *s = &p->service[h->exception];
    unsigned octave = 63 - (unsigned)__builtin_clzll(own | 8);
    unsigned bin = (octave - 3) * 8 + (own >> (octave - 3) & 7);
    s->bin[bin < BINS ? bin : BINS - 1]++;
    s->count++;
    s->cycles += own;
    if (own > s->worst) {
        s->worst = own;
        s->when = h->begin;
    }
}

/* After an exception: what it has interrupted continues, or another task. */
void profile_resume(struct machine *m)
{
    struct profile *p = m->profile;
    charge(m, m->now);
    unsigned task = m->task_count ? m->running : TASKS;
    look_at_context(m, p->level ? TASKS + 1 + p->handler[p->level].exception : task);
    if (!p->level && !p->activity[task].number)
        begin_activation(m, &p->activity[task]);
}

void profile_reset(struct machine *m)
{
    struct profile *p = m->profile;
    charge(m, m->now);
    p->level = 0;
    for (unsigned i = 0; i < STACKS; i++)
        p->calls[i].depth = 0;
    for (unsigned i = 0; i <= TASKS; i++)
        p->activity[i].number = 0;
    p->masked_since[0] = p->masked_since[1] = 0;
    look_at_context(m, m->task_count ? m->running : TASKS);
    begin_activation(m, &p->activity[p->root]);
}

static void push(struct profile *p, struct calls *calls, uint32_t function, uint32_t site, uint32_t back)
{
    uint32_t parent = calls->frame[calls->depth].node;
    if (calls->depth + 1 == FRAMES) {
        p->lost++;
        return;
    }
    calls->frame[++calls->depth] = (struct frame){.node = child_of(p, parent, function, site), .back = back};
}

/* Another function runs at `at`, or the same one anew. */
static void change_function(struct machine *m, uint32_t at, uint32_t function)
{
    struct profile *p = m->profile;
    struct calls *calls = running_calls(m);
    uint32_t down = calls->depth > LOOK_DOWN ? calls->depth - LOOK_DOWN : 0, last = p->last;
    for (uint32_t i = calls->depth; i > down; i--)
        if (calls->frame[i].back == at) {
            calls->depth = i - 1;
            return;
        }
    uint16_t before = last ? half_word(m, last - 2) : 0;
    int called = (before & 0xFF80) == 0x4780 || (last && half_word(m, last - 4) >> 11 == 0x1E && before >> 14 == 3);
    if (p->functions[at / 2] & FIRST_INSTRUCTION && called) {
        push(p, calls, function, last, last);
        p->node[calls->frame[calls->depth].node].calls++;
        return;
    }
    if (function == p->function)
        return;
    for (uint32_t i = calls->depth; i > down; i--)
        if (p->node[calls->frame[i].node].function == function) {
            calls->depth = i;
            return;
        }
    if (!calls->depth) {
        push(p, calls, function, 0, NO_RETURN);
    } else { /* the function has jumped to its end in another one */
        struct frame left = calls->frame[calls->depth--];
        push(p, calls, function, p->node[left.node].site, left.back);
    }
    p->node[calls->frame[calls->depth].node].calls++;
}

/* A block begins at an offset in flash, and ends at another one. */
void profile_block(struct machine *m, uint32_t at, uint32_t end)
{
    struct profile *p = m->profile;
    uint32_t function = p->functions[at / 2];
    look_at_masks(m);
    if (function != p->function || at == p->back) {
        charge(m, m->now);
        change_function(m, at, function & ~(uint32_t)FIRST_INSTRUCTION);
        look_at_calls(m);
    }
    p->last = end;
}

/* Charge what has passed since. */
void profile_settle(struct machine *m)
{
    charge(m, m->now);
}

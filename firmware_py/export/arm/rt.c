/* Functions that compilers call implicitly; there is no C library around the core. */
#include <stddef.h>

void *memset(void *to, int value, size_t size)
{
    volatile unsigned char *byte = to; /* volatile: or this loop would become a call of memset */
    while (size-- > 0)
        *byte++ = (unsigned char)value;
    return to;
}

void *memcpy(void *to, const void *from, size_t size)
{
    volatile unsigned char *byte = to;
    const unsigned char *source = from;
    while (size-- > 0)
        *byte++ = *source++;
    return to;
}

void *memmove(void *to, const void *from, size_t size)
{
    volatile unsigned char *byte = to;
    const unsigned char *source = from;
    if (byte <= source)
        return memcpy(to, from, size);
    while (size-- > 0)
        byte[size] = source[size];
    return to;
}

void __aeabi_memclr(void *to, size_t size)
{
    memset(to, 0, size);
}

/* As memcpy, but without its result; both also for memory that is aligned to words. */
void __aeabi_memcpy(void *to, const void *from, size_t size)
{
    memcpy(to, from, size);
}

void __aeabi_memclr4(void *to, size_t size) __attribute__((alias("__aeabi_memclr")));
void __aeabi_memcpy4(void *to, const void *from, size_t size) __attribute__((alias("__aeabi_memcpy")));

/* A C library of eight functions. Memory is a fixed piece that begins anew whenever everything is given back, which is after each
 * call of the host: so a law cannot leak slowly, every call finds the same memory, and what a call takes has a bound.
 *
 *   block: 8 bytes with its size, then its bytes, rounded up to 8
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* The largest state (64 KiB) in, a copy of it, and the next one out, with room for a descriptor. */
#define PIECE_BYTES (224 * 1024)
#define HEAD_BYTES 8

static _Alignas(8) uint8_t piece[PIECE_BYTES];
static size_t used;
static size_t blocks;

_Noreturn void abort(void) { __builtin_trap(); }

void *malloc(size_t size) {
    if (size > PIECE_BYTES - HEAD_BYTES) abort();
    size_t whole = HEAD_BYTES + ((size + 7) & ~(size_t)7);
    if (whole > PIECE_BYTES - used) abort();
    uint8_t *block = piece + used;
    memcpy(block, &size, sizeof size);
    used += whole;
    blocks += 1;
    return block + HEAD_BYTES;
}

void *realloc(void *block, size_t size) {
    if (block == NULL) return malloc(size);
    size_t before;
    memcpy(&before, (uint8_t *)block - HEAD_BYTES, sizeof before);
    if (size <= before) return block;
    void *larger = malloc(size);
    memcpy(larger, block, before);
    free(block);
    return larger;
}

void free(void *block) {
    if (block == NULL) return;
    blocks -= 1;
    if (blocks == 0) used = 0;
}

void *memcpy(void *restrict to, const void *restrict from, size_t size) {
    uint8_t *t = to;
    const uint8_t *f = from;
    for (size_t i = 0; i < size; i++) t[i] = f[i];
    return to;
}

void *memset(void *to, int value, size_t size) {
    uint8_t *t = to;
    for (size_t i = 0; i < size; i++) t[i] = (uint8_t)value;
    return to;
}

int memcmp(const void *one, const void *other, size_t size) {
    const uint8_t *a = one, *b = other;
    for (size_t i = 0; i < size; i++) {
        if (a[i] != b[i]) return a[i] < b[i] ? -1 : 1;
    }
    return 0;
}

size_t strlen(const char *text) {
    size_t length = 0;
    while (text[length] != 0) length += 1;
    return length;
}

/* What the generated bindings need of a C library; libc.c has it. A law that wants more (math.h, stdio.h) takes wasi-libc and
 * links it with --target=wasm32-wasi: pure functions ask the host for nothing. */
#ifndef LIBC_STDLIB_H
#define LIBC_STDLIB_H
#include <stddef.h>
void *malloc(size_t size);
void *realloc(void *block, size_t size);
void free(void *block);
_Noreturn void abort(void);
#endif

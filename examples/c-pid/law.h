/* The arithmetic of the example law, PI(D) with clamping. examples/rust-pid/src/law.rs has the formulae and their sources.
 *
 * Only + - * / and comparisons are used, in the same order as in the other languages, so the numbers are the same to the last
 * bit: WebAssembly has no fused multiply-add that a compiler could put in their place. */
#ifndef LAW_H
#define LAW_H
#include <stdbool.h>

typedef struct {
    double gain, ti, td, td_filter, low, high;
} tuning_t;

/* What lasts from step to step. */
typedef struct {
    bool running;
    double integral, derivative, pv, setpoint, output;
} memory_t;

/* Computes one automatic step and gives the output; `held` is what the actuator holds, `dt_s` is greater than 0. */
double law_step(const tuning_t *t, memory_t *m, double pv, double setpoint, double held, double dt_s);

/* Moves the integral so that the output for the last sample stays what it was. */
void law_retune(memory_t *m, const tuning_t *old, const tuning_t *next);
#endif

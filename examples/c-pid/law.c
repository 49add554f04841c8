#include "law.h"

static double limited(const tuning_t *t, double value) {
    if (value > t->high) return t->high;
    if (value < t->low) return t->low;
    return value;
}

double law_step(const tuning_t *t, memory_t *m, double pv, double setpoint, double held, double dt_s) {
    double error = setpoint - pv;
    if (m->running) {
        m->derivative = (t->td_filter * m->derivative + t->td * (m->pv - pv)) / (t->td_filter + dt_s);
        double change = t->ti > 0.0 ? t->gain * error * dt_s / t->ti : 0.0;
        double rest = t->gain * (error + m->derivative);
        double wanted = m->integral + change + rest;
        bool further = (wanted > t->high && change > 0.0) || (wanted < t->low && change < 0.0);
        if (!further) m->integral += change;
        m->output = limited(t, m->integral + rest);
    } else {
        m->running = true;
        m->derivative = 0.0;
        m->integral = held - t->gain * error;
        m->output = limited(t, held);
    }
    m->pv = pv;
    m->setpoint = setpoint;
    return m->output;
}

static bool same(const tuning_t *a, const tuning_t *b) {
    return a->gain == b->gain && a->ti == b->ti && a->td == b->td && a->td_filter == b->td_filter && a->low == b->low &&
           a->high == b->high;
}

void law_retune(memory_t *m, const tuning_t *old, const tuning_t *next) {
    if (same(old, next)) return;
    double error = m->setpoint - m->pv;
    double before = old->gain * (error + m->derivative);
    if (next->td == 0.0) m->derivative = 0.0;
    m->integral = m->integral + before - next->gain * (error + m->derivative);
}

/* The component `c-pid`: glue between the generated bindings (controller.h) and the law (law.h).
 *
 * Never: arithmetic, or anything kept between calls outside the state bytes; a step may run twice, on any host. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "controller.h"
#include "law.h"

#define NAME "c-pid"
#define STATE_LAYOUT 1

typedef exports_bumpless_control_control_fault_t fault_t;
typedef exports_bumpless_control_control_port_t port_t;
typedef exports_bumpless_control_control_parameter_t parameter_t;

enum { PV, OUT, PORTS };
enum { PARAMETERS = 6 };

static const struct {
    const char *name, *unit;
    double value, minimum, maximum;
    const char *text;
} TABLE[PARAMETERS] = {
    {"gain", "out/pv", 1.0, -1e6, 1e6, "Gain; below 0 for direct action"},
    {"ti", "s", 10.0, 0.0, 1e6, "Integral time; 0 for none"},
    {"td", "s", 0.0, 0.0, 1e6, "Derivative time; 0 for none"},
    {"td-filter", "s", 1.0, 0.0, 1e6, "Filter time of the derivative"},
    {"out-low", "out", 0.0, -1e9, 1e9, "Least output"},
    {"out-high", "out", 100.0, -1e9, 1e9, "Greatest output"},
};

/* The same law in other languages: their states are taken over. */
static const char *const FAMILY[] = {NAME, "rust-pid", "rust-wasip2-pid", "js-pid", "ts-pid", "python-pid"};

static bool fail(fault_t *err, uint8_t tag, const char *text) {
    err->tag = tag;
    /* All cases hold one text, in the same place. */
    controller_string_dup(&err->val.failed, text);
    return false;
}

static bool bad_state(fault_t *err, const char *text) { return fail(err, BUMPLESS_CONTROL_TYPES_FAULT_BAD_STATE, text); }

static bool is_number(double value) { return value - value == 0.0; }

/* The state bytes, all little endian as WebAssembly itself: mark, length and text of the name, layout, number of parameters,
 * their values, memory. */
#define MARK 0xB1
#define TUNING_BYTES (8 * PARAMETERS)
#define MEMORY_BYTES (1 + 8 * 5)

static void encode(const tuning_t *t, const memory_t *m, controller_list_u8_t *ret) {
    const size_t length = strlen(NAME);
    const uint32_t layout = STATE_LAYOUT;
    ret->len = 7 + length + TUNING_BYTES + MEMORY_BYTES;
    ret->ptr = malloc(ret->len);
    uint8_t *at = ret->ptr;
    *at++ = MARK;
    *at++ = (uint8_t)length;
    memcpy(at, NAME, length);
    at += length;
    memcpy(at, &layout, 4);
    at += 4;
    *at++ = PARAMETERS;
    const double tuning[PARAMETERS] = {t->gain, t->ti, t->td, t->td_filter, t->low, t->high};
    memcpy(at, tuning, TUNING_BYTES);
    at += TUNING_BYTES;
    *at++ = m->running ? 1 : 0;
    const double values[5] = {m->integral, m->derivative, m->pv, m->setpoint, m->output};
    memcpy(at, values, sizeof values);
}

/* Takes the state apart, which the caller gives back. `name` becomes the writer's place in FAMILY. */
static bool decode(const controller_list_u8_t *state, size_t *name, tuning_t *t, memory_t *m, fault_t *err) {
    const uint8_t *bytes = state->ptr;
    if (state->len < 2 || bytes[0] != MARK) return bad_state(err, "the state is not of this form");
    const size_t length = bytes[1];
    if (state->len != 7 + length + TUNING_BYTES + MEMORY_BYTES) return bad_state(err, "the state has another length");
    const size_t known = sizeof FAMILY / sizeof *FAMILY;
    for (*name = 0; *name < known; *name += 1) {
        if (strlen(FAMILY[*name]) == length && memcmp(FAMILY[*name], bytes + 2, length) == 0) break;
    }
    uint32_t layout;
    memcpy(&layout, bytes + 2 + length, 4);
    if (*name == known || layout != STATE_LAYOUT || bytes[6 + length] != PARAMETERS) {
        return bad_state(err, "the state is not of this law");
    }
    const uint8_t *at = bytes + 7 + length;
    double tuning[PARAMETERS], values[5];
    memcpy(tuning, at, TUNING_BYTES);
    memcpy(values, at + TUNING_BYTES + 1, sizeof values);
    *t = (tuning_t){tuning[0], tuning[1], tuning[2], tuning[3], tuning[4], tuning[5]};
    *m = (memory_t){at[TUNING_BYTES] == 1, values[0], values[1], values[2], values[3], values[4]};
    return true;
}

/* The values, or a fault: a component that is run elsewhere must stand on its own. */
static bool check(const controller_list_f64_t *parameters, const controller_list_f64_t *track, tuning_t *t, fault_t *err) {
    const uint8_t bad = BUMPLESS_CONTROL_TYPES_FAULT_BAD_PARAMETER;
    if (parameters->len != PARAMETERS) return fail(err, bad, "one value per parameter is needed");
    const double *p = parameters->ptr;
    for (size_t i = 0; i < PARAMETERS; i++) {
        if (!(p[i] >= TABLE[i].minimum && p[i] <= TABLE[i].maximum)) return fail(err, bad, "a parameter is out of its range");
    }
    if (track->len != 1 || !is_number(track->ptr[0])) return fail(err, bad, "track needs one finite value per output port");
    *t = (tuning_t){p[0], p[1], p[2], p[3], p[4], p[5]};
    return true;
}

// No plant measures more than 1e12, nor wants it; the law's numbers stay finite for as long.
static bool is_sane(double value) {
    return value >= -1e12 && value <= 1e12;
}

static bool usable(const bumpless_control_io_reading_t *reading) {
    return reading->quality != BUMPLESS_CONTROL_TYPES_QUALITY_BAD && is_sane(reading->value);
}

void exports_bumpless_control_control_describe(exports_bumpless_control_control_descriptor_t *ret) {
    controller_string_dup(&ret->name, NAME);
    controller_string_dup(&ret->version, "0.1.0");
    controller_string_dup(&ret->text, "The example law in C: PI(D) with clamping");
    ret->state_layout = STATE_LAYOUT;

    ret->ports.len = PORTS;
    ret->ports.ptr = malloc(PORTS * sizeof(port_t));
    for (size_t i = 0; i < PORTS; i++) {
        port_t *port = ret->ports.ptr + i;
        controller_string_dup(&port->name, i == PV ? "pv" : "out");
        port->direction = i == PV ? EXPORTS_BUMPLESS_CONTROL_CONTROL_DIRECTION_INPUT
                                  : EXPORTS_BUMPLESS_CONTROL_CONTROL_DIRECTION_OUTPUT;
        port->kind = EXPORTS_BUMPLESS_CONTROL_CONTROL_KIND_ANALOG;
        controller_string_dup(&port->unit, "");
        port->required = true;
        controller_string_dup(&port->text, i == PV ? "Measurement, in the unit of the setpoint" : "To the actuator");
    }

    ret->parameters.len = PARAMETERS;
    ret->parameters.ptr = malloc(PARAMETERS * sizeof(parameter_t));
    for (size_t i = 0; i < PARAMETERS; i++) {
        parameter_t *parameter = ret->parameters.ptr + i;
        controller_string_dup(&parameter->name, TABLE[i].name);
        controller_string_dup(&parameter->unit, TABLE[i].unit);
        parameter->default_ = TABLE[i].value;
        parameter->minimum = TABLE[i].minimum;
        parameter->maximum = TABLE[i].maximum;
        parameter->choices.ptr = NULL;
        parameter->choices.len = 0;
        controller_string_dup(&parameter->text, TABLE[i].text);
    }
}

bool exports_bumpless_control_control_start(controller_list_f64_t *parameters, controller_list_f64_t *track,
                                            controller_list_u8_t *ret, fault_t *err) {
    tuning_t t;
    bool done = check(parameters, track, &t, err);
    if (done) {
        const memory_t m = {false, track->ptr[0], 0.0, 0.0, 0.0, track->ptr[0]};
        encode(&t, &m, ret);
    }
    controller_list_f64_free(parameters);
    controller_list_f64_free(track);
    return done;
}

static bool step(const exports_bumpless_control_control_cycle_t *cycle, const controller_list_u8_t *state,
                 controller_list_u8_t *ret, fault_t *err) {
    size_t name;
    tuning_t t;
    memory_t m;
    if (!decode(state, &name, &t, &m, err)) return false;
    if (name != 0) return bad_state(err, "the state belongs to another component");
    bumpless_control_io_reading_t reading;
    bumpless_control_io_read(OUT, &reading);
    const double held = usable(&reading) ? reading.value : m.output;
    if (cycle->mode == BUMPLESS_CONTROL_TYPES_MODE_MANUAL) {
        m.running = false;
        m.output = held;
        bumpless_control_io_write(OUT, held);
    } else {
        bumpless_control_io_read(PV, &reading);
        if ((cycle->connected >> PV & 1) == 0 || !usable(&reading)) {
            return fail(err, BUMPLESS_CONTROL_TYPES_FAULT_BAD_INPUT, "pv has no usable value");
        }
        if (!is_sane(cycle->setpoint)) {
            return fail(err, BUMPLESS_CONTROL_TYPES_FAULT_BAD_INPUT, "the setpoint is beyond 1e12");
        }
        const double dt_s = (double)cycle->dt_ns * 1e-9;
        bumpless_control_io_write(OUT, law_step(&t, &m, reading.value, cycle->setpoint, held, dt_s));
    }
    encode(&t, &m, ret);
    return true;
}

bool exports_bumpless_control_control_step(exports_bumpless_control_control_cycle_t *cycle, controller_list_u8_t *state,
                                           controller_list_u8_t *ret, fault_t *err) {
    bool done = step(cycle, state, ret, err);
    controller_list_u8_free(state);
    return done;
}

bool exports_bumpless_control_control_migrate(exports_bumpless_control_control_origin_t *from, controller_list_u8_t *state,
                                              controller_list_f64_t *parameters, controller_list_f64_t *track,
                                              controller_list_u8_t *ret, fault_t *err) {
    size_t name;
    tuning_t old, next;
    memory_t m;
    bool done = check(parameters, track, &next, err) && decode(state, &name, &old, &m, err);
    if (done) {
        const size_t length = strlen(FAMILY[name]);
        if (from->state_layout != STATE_LAYOUT || from->name.len != length ||
            memcmp(from->name.ptr, FAMILY[name], length) != 0) {
            done = bad_state(err, "the bytes name another component or layout than their origin does");
        }
    }
    if (done) {
        law_retune(&m, &old, &next);
        encode(&next, &m, ret);
    }
    exports_bumpless_control_control_origin_free(from);
    controller_list_u8_free(state);
    controller_list_f64_free(parameters);
    controller_list_f64_free(track);
    return done;
}

/* One instance of a model, apart from the version of FMI that it is called by. Value references count inputs, outputs,
 * parameters. Sample n is at t_0 + n T_s; it is taken in the communication step that begins at or before it, with the
 * inputs held then. A plant's new outputs show when communication reaches sample n + 1, those of all else at once.
 * Model Exchange: no continuous states, and a time event at each sample, where it is taken with the inputs of that
 * event. A plant's outputs of sample n show in the event at t_0 + n T_s, as in Co-Simulation; those of all else as well,
 * which is one sample before the end of the communication step that shows them in Co-Simulation. */
#ifndef SN_INSTANCE_H
#define SN_INSTANCE_H

#include "sn_model.h"

enum { SN_WARN = 1, SN_FAIL = 3 };

/* Share of a sample time: hosts add up their time, and 1e6 steps of 2 ms are off by 1e-7 s at most. */
#define SN_SAME_TIME 1e-4
#define SN_MOST_SAMPLES 1e9
#define SN_NEVER DBL_MAX /* the stop time of a host that defines none */

typedef struct {
    sn_model model;
    sn_work work;
    sn_v1 values, inputs, outputs, parameters, pending, state; /* `parameters` without `limit_outputs` */
    unsigned char *warned; /* of inputs and outputs */
    int32_t validity; /* its place among the outputs, -1 for none */
    double start, time, stop;
    int64_t count, states;
    int running, stale, stepping;
    /* State, outputs and what moves them, of a step that is looked at and not taken yet; `looked` says what of it holds. */
    sn_v1 next_state, next;
    sn_v2 state_rows, input_rows, next_rows;
    int looked;
    /* The same of the samples behind it, up to the horizon. */
    sn_v1 far_state, far_inputs, far;
    sn_v2 far_state_rows, far_input_rows, far_rows;
    /* Of Model Exchange: whether it is one and in event mode; the event at `instant` took samples from number `first` on,
     * out of what `saved` holds (pending outputs, state), with the inputs in `seen`, `rounds` times. */
    int exchange, event, sampled;
    double instant;
    int64_t first, rounds;
    sn_v1 saved, seen;
    char *instance_name;
    /* Of the version of FMI. */
    void (*tell)(void *self, int status, const char *text);
    void *environment;
    void *logger;
} sn_instance;

typedef struct {
    double start, time, instant;
    int64_t count, running, event, sampled, first, rounds;
    double values[];
} sn_snapshot;

static void sn_say(sn_instance *s, int status, const char *format, ...)
{
    char text[SN_TEXT + 100];
    va_list list;
    int used = snprintf(text, sizeof text, "%.100s: ", s->model.name != NULL ? s->model.name : "softneck");
    va_start(list, format);
    vsnprintf(text + used, sizeof text - (size_t)used, format, list);
    va_end(list);
    if (s->tell != NULL)
        s->tell(s, status, text);
}

static void sn_free_instance(sn_instance *s)
{
    if (s == NULL)
        return;
    sn_free_model(&s->model);
    free(s->work.base);
    free(s->values.p);
    free(s->warned);
    free(s->instance_name);
    free(s);
}

static void sn_ready(sn_work *w)
{
    w->top = 0;
    w->fuel = SN_FUEL;
    w->fault = NULL;
}

enum { SN_SIZE, SN_INITIALISE, SN_STEP, SN_LOOK, SN_MOVE, SN_FAR, SN_FAR_MOVE };
/* The outputs of the next sample are shown; its state and outputs are there; those at the horizon are shown. */
enum { SN_SHOWN = 1, SN_WORKED_OUT = 2, SN_FAR_SHOWN = 4 };

/* Let the kind do one of its things; 0 where it broke a rule, `fault` then says which. Nothing else may stand
 * here: what is in this function's registers is gone when `sn_fault` comes back to it. */
static int sn_guarded(sn_instance *s, int what)
{
    const sn_node *root = &s->model.root;
    sn_ready(&s->work);
    if (SN_STAY(s->work.out) == 0) {
        if (what == SN_SIZE)
            s->states = root->kind->state_size(&s->work, root);
        else if (what == SN_INITIALISE)
            root->kind->initialise(&s->work, root, s->parameters, s->state, s->pending);
        else if (what == SN_STEP)
            root->kind->step(&s->work, root, s->parameters, s->state, s->inputs, s->pending);
        else if (what == SN_LOOK)
            root->kind->step(&s->work, root, s->parameters, s->next_state, s->inputs, s->next);
        else if (what == SN_FAR)
            root->kind->step(&s->work, root, s->parameters, s->far_state, s->far_inputs, s->far);
        else if (what == SN_FAR_MOVE)
            root->kind->tangent(&s->work, root, s->parameters, s->far_state, s->far_inputs, s->far, &s->far_state_rows,
                                &s->far_input_rows, &s->far_rows, 1);
        else
            root->kind->tangent(&s->work, root, s->parameters, s->next_state, s->inputs, s->next, &s->state_rows,
                                &s->input_rows, &s->next_rows, 1);
        return 1;
    }
    return 0;
}

/* Room for what a step keeps for a while: many times what any kind takes. */
static size_t sn_room_needed(const sn_node *node)
{
    size_t bytes = 0;
    for (int32_t i = 0; i < node->array_count; i++)
        for (int k = 0; k < node->arrays[i].rank; k++) {
            size_t n = (size_t)node->arrays[i].n[k];
            bytes += n <= 512 ? 32u * n * n + 512u * n : n <= 8192 ? 512u * n : 0u;
        }
    for (int32_t i = 0; i < node->member_count; i++)
        bytes += sn_room_needed(&node->members[i]);
    return bytes;
}

/* Whether the last parameter is the instance's own: outputs end at their declared limits. */
static int sn_has_limits(const sn_model *m)
{
    return m->n_par > 0 && strcmp(m->ports[m->n_in + m->n_out + m->n_par - 1u].name, "limit_outputs") == 0;
}

static int sn_make_room(sn_instance *s)
{
    const sn_model *m = &s->model;
    size_t ports = (size_t)m->n_in + m->n_out + m->n_par, own = m->n_out - m->next - m->ahead, looks, kept, i;
    double *p, *more;
    s->work.size = 262144u + sn_room_needed(&m->root) + 64u * ports;
    s->work.base = (unsigned char *)malloc(s->work.size);
    if (s->work.base == NULL)
        return 0;
    s->work.wide = sn_has_wide();
    if (!sn_guarded(s, SN_SIZE) || s->states < 0 || s->states > SN_MOST_STATES) {
        sn_say(s, SN_FAIL, "%s", s->work.fault != NULL ? s->work.fault : "the model has too many states");
        return 0;
    }
    looks = m->next > 0 ? 2u * ((size_t)s->states + own) + m->n_in : 0u;
    looks += m->ahead > 0 ? 2u * ((size_t)s->states + own + m->n_in) : 0u;
    kept = s->exchange ? own + (size_t)s->states + m->n_in : 0u;
    p = (double *)calloc(ports + own + (size_t)s->states + kept + looks + 1u, sizeof(double));
    s->warned = (unsigned char *)calloc((size_t)m->n_in + m->n_out + 1u, 1);
    if (p == NULL || s->warned == NULL) {
        free(p);
        return 0;
    }
    s->values = (sn_v1){p, (int32_t)ports, 1};
    s->inputs = (sn_v1){p, (int32_t)m->n_in, 1};
    s->outputs = (sn_v1){p + m->n_in, (int32_t)m->n_out, 1};
    s->parameters = (sn_v1){p + m->n_in + m->n_out, (int32_t)(m->n_par - (uint32_t)sn_has_limits(m)), 1};
    s->validity = -1;
    for (i = 0; i < own; i++)
        if (strcmp(m->ports[m->n_in + i].name, "validity") == 0)
            s->validity = (int32_t)i;
    s->pending = (sn_v1){p + ports, (int32_t)own, 1};
    s->state = (sn_v1){p + ports + own, (int32_t)s->states, 1};
    more = s->state.p + s->states;
    s->saved = (sn_v1){more, s->exchange ? (int32_t)(own + (size_t)s->states) : 0, 1};
    s->seen = (sn_v1){more + s->saved.n, s->exchange ? (int32_t)m->n_in : 0, 1};
    more += kept;
    if (m->next > 0) {
        s->next_state = (sn_v1){more, (int32_t)s->states, 1};
        s->next = (sn_v1){more += s->states, (int32_t)own, 1};
        s->state_rows = (sn_v2){more += own, (int32_t)s->states, 1, 1, 1};
        s->input_rows = (sn_v2){more += s->states, (int32_t)m->n_in, 1, 1, 1};
        s->next_rows = (sn_v2){more += m->n_in, (int32_t)own, 1, 1, 1};
        more += own;
    }
    if (m->ahead > 0) {
        s->far_state = (sn_v1){more, (int32_t)s->states, 1};
        s->far_inputs = (sn_v1){more += s->states, (int32_t)m->n_in, 1};
        s->far = (sn_v1){more += m->n_in, (int32_t)own, 1};
        s->far_state_rows = (sn_v2){more += own, (int32_t)s->states, 1, 1, 1};
        s->far_input_rows = (sn_v2){more += s->states, (int32_t)m->n_in, 1, 1, 1};
        s->far_rows = (sn_v2){more + m->n_in, (int32_t)own, 1, 1, 1};
    }
    for (i = 0; i < ports; i++) /* what nobody connects or sets was not measured */
        p[i] = i < m->n_in && (m->ports[i].flags & SN_MISSING) ? sn_from_bits(0x7ff8000000000000u) : m->ports[i].start;
    return 1;
}

/* As it was when it was made. */
static void sn_restart(sn_instance *s)
{
    const sn_model *m = &s->model;
    for (int64_t i = 0; i < s->values.n; i++)
        s->values.p[i] = i < m->n_in && (m->ports[i].flags & SN_MISSING) ? sn_from_bits(0x7ff8000000000000u)
                                                                        : m->ports[i].start;
    memset(s->pending.p, 0, (size_t)(s->pending.n + s->state.n) * sizeof(double));
    memset(s->warned, 0, (size_t)m->n_in + m->n_out);
    s->start = s->time = 0.0;
    s->stop = SN_NEVER;
    s->count = 0;
    s->running = s->event = s->sampled = 0;
    s->stale = 1;
    s->looked = 0;
}

static int sn_worked(sn_instance *s, int what)
{
    if (sn_guarded(s, what))
        return 1;
    sn_say(s, SN_FAIL, "%s.", s->work.fault);
    return 0;
}

/* Whether an output leaves what was declared; a model that ends at its limit may miss it by rounding. */
static int sn_beyond(const sn_port *port, double x)
{
    double slack = 1e-9 * (1.0 + fabs(x));
    return x < port->low - slack || x > port->high + slack;
}

/* Whether output `i` is held at its limit instead of `x`. */
static int sn_is_limited(const sn_instance *s, uint32_t i, double x)
{
    return sn_has_limits(&s->model) && s->values.p[s->values.n - 1] != 0.0 && sn_beyond(&s->model.ports[s->model.n_in + i], x);
}

static double sn_limited(const sn_instance *s, uint32_t i, double x)
{
    const sn_port *port = &s->model.ports[s->model.n_in + i];
    return !sn_is_limited(s, i, x) ? x : x < port->low ? port->low : port->high;
}

/* An output outside of its range: said once, and the outputs of this sample are not valid. */
SN_APART static void sn_leave_range(sn_instance *s, uint32_t i)
{
    const sn_port *port = &s->model.ports[s->model.n_in + i];
    double x = s->pending.p[i];
    if (!s->warned[s->model.n_in + i])
        sn_say(s, SN_WARN, "output %.80s = %g is outside %g to %g %.20s: the model is not valid there.", port->name, x,
               port->low, port->high, port->unit);
    s->warned[s->model.n_in + i] = 1;
    s->pending.p[i] = sn_limited(s, i, x);
    if (s->validity >= 0)
        s->pending.p[s->validity] = 0.0;
}

static int sn_check_outputs(sn_instance *s)
{
    int calm = 1;
    for (int64_t i = 0; i < s->pending.n; i++) {
        double x = s->pending.p[i];
        const sn_port *port = &s->model.ports[s->model.n_in + i];
        calm &= sn_finite(x) && x >= port->low && x <= port->high;
    }
    if (calm)
        return 1;
    for (int64_t i = 0; i < s->pending.n; i++) {
        double x = s->pending.p[i];
        const sn_port *port = &s->model.ports[s->model.n_in + i];
        if (sn_beyond(port, x) && sn_finite(x))
            sn_leave_range(s, (uint32_t)i);
        if (sn_infinite(x) || (sn_nan(x) && !(port->flags & SN_MISSING))) {
            sn_say(s, SN_FAIL, "output %.80s became %f at t = %.6g s: the model has diverged.", port->name, x,
                   s->start + (double)s->count * s->model.sample_time);
            return 0;
        }
    }
    return 1;
}

static int sn_initialise(sn_instance *s)
{
    if (!s->stale)
        return 1;
    memset(s->state.p, 0, (size_t)s->state.n * sizeof(double));
    /* A controller decides in its first step; set-points rest at zero before, allowed or not. */
    if (!sn_worked(s, SN_INITIALISE) || (s->model.plant && !sn_check_outputs(s)))
        return 0;
    memcpy(s->outputs.p, s->pending.p, (size_t)s->pending.n * sizeof(double));
    s->stale = 0;
    return 1;
}

static int sn_begin(sn_instance *s, double start, double stop)
{
    if (!sn_finite(start)) {
        sn_say(s, SN_FAIL, "the start time is %f; it must be finite.", start);
        return 0;
    }
    s->start = s->time = start;
    s->stop = stop;
    s->count = 0;
    s->sampled = 0;
    s->looked = 0;
    return 1;
}

/* From here on parameters are fixed, but for tunable ones. */
static int sn_run(sn_instance *s)
{
    if (!sn_initialise(s))
        return 0;
    s->running = 1;
    s->event = s->exchange; /* initialisation ends in the first event */
    return 1;
}

static int sn_take_sample(sn_instance *s)
{
    size_t bytes = (size_t)s->pending.n * sizeof(double);
    if (s->model.plant)
        memcpy(s->outputs.p, s->pending.p, bytes);
    if (s->looked & SN_WORKED_OUT) { /* whoever asked for a derivative has paid for this step */
        memcpy(s->state.p, s->next_state.p, (size_t)s->state.n * sizeof(double));
        memcpy(s->pending.p, s->next.p, bytes);
    } else if (!sn_worked(s, SN_STEP)) {
        return 0;
    }
    s->looked = 0;
    s->count++;
    if (!s->model.plant)
        memcpy(s->outputs.p, s->pending.p, bytes);
    return sn_check_outputs(s);
}

static int sn_do_step(sn_instance *s, double time, double size)
{
    double period = s->model.sample_time, slack = SN_SAME_TIME * period, end = time + size;
    if (s->exchange || !s->running) {
        sn_say(s, SN_FAIL, s->exchange ? "this instance is for Model Exchange, which has no communication steps."
                                       : "a step before the initialisation has ended.");
        return 0;
    }
    if (!sn_finite(end) || size < 0.0 || end - s->start > ((double)s->count + SN_MOST_SAMPLES) * period) {
        sn_say(s, SN_FAIL, "a step from %g s over %g s cannot be taken.", time, size);
        return 0;
    }
    if (end > s->stop && end - s->stop > slack + 1e-9 * fabs(s->stop)) { /* hosts round their times */
        sn_say(s, SN_FAIL, "a step from %g s over %g s goes past the stop time of %g s.", time, size, s->stop);
        return 0;
    }
    if (!sn_initialise(s))
        return 0;
    while (s->start + (double)s->count * period < end - slack)
        if (!sn_take_sample(s))
            return 0;
    /* A plant's next outputs belong to the next sample: they show when that is reached. */
    if (s->model.plant && s->start + (double)s->count * period <= end + slack)
        memcpy(s->outputs.p, s->pending.p, (size_t)s->pending.n * sizeof(double));
    s->time = end;
    s->looked = 0;
    return 1;
}

/* Whether the next sample is due. */
static int sn_due(const sn_instance *s)
{
    double period = s->model.sample_time;
    return s->start + (double)s->count * period <= s->time + SN_SAME_TIME * period;
}

/* Whether a sample was taken in the event at this time: other inputs take it anew, from what was saved. */
static int sn_at_sample(const sn_instance *s) { return s->sampled && s->time == s->instant; }

/* Whether the next sample is still open: behind a sample that was taken between two, inputs no longer change it. */
static int sn_awaits(const sn_instance *s)
{
    return sn_due(s) || (s->exchange && (!s->model.plant || sn_at_sample(s)));
}

/* Model Exchange. */
static int sn_set_time(sn_instance *s, double time)
{
    if (!sn_finite(time)) {
        sn_say(s, SN_FAIL, "the time was set to %f; it must be finite.", time);
        return 0;
    }
    s->time = time;
    s->looked = 0;
    return 1;
}

static int sn_enter_event(sn_instance *s)
{
    if (!s->running) {
        sn_say(s, SN_FAIL, "an event before the initialisation has ended.");
        return 0;
    }
    s->event = 1;
    if (s->model.plant && sn_due(s)) /* outputs of this sample, which its inputs do not change */
        memcpy(s->outputs.p, s->pending.p, (size_t)s->pending.n * sizeof(double));
    return 1;
}

#define SN_MOST_ROUNDS 1000 /* event iterations of one sample: importers stop far before */

/* Take what is due, or take it anew where the importer iterates over inputs. `again`: outputs have changed, and whoever
 * they are connected to must see them. `next`: the time of the next sample, counted and not summed. */
static int sn_update(sn_instance *s, int *again, double *next)
{
    double period = s->model.sample_time;
    size_t held = (size_t)s->saved.n * sizeof(double), given = (size_t)s->seen.n * sizeof(double);
    int anew = sn_at_sample(s) && memcmp(s->seen.p, s->inputs.p, given) != 0;
    *again = 0;
    if (!s->running || !s->event) {
        sn_say(s, SN_FAIL, "discrete states are updated in event mode only.");
        return 0;
    }
    if (s->time - s->start > ((double)s->count + SN_MOST_SAMPLES) * period) {
        sn_say(s, SN_FAIL, "an event at %g s is too late.", s->time);
        return 0;
    }
    if (anew && s->rounds >= SN_MOST_ROUNDS) {
        sn_say(s, SN_FAIL, "its inputs do not settle in the event at %g s: delay one signal of the loop by a sample.", s->time);
        return 0;
    }
    if (anew || (!sn_at_sample(s) && sn_due(s))) {
        if (!sn_initialise(s))
            return 0;
        if (anew) { /* pending outputs and state stand behind each other */
            memcpy(s->pending.p, s->saved.p, held);
            s->count = s->first;
        } else {
            memcpy(s->saved.p, s->pending.p, held);
            s->first = s->count;
            s->rounds = 0;
        }
        memcpy(s->seen.p, s->inputs.p, given);
        s->instant = s->time;
        s->sampled = 1;
        s->rounds++;
        do {
            s->looked = 0;
            if (!sn_take_sample(s))
                return 0;
        } while (sn_due(s));
        *again = !s->model.plant || s->count > s->first + 1;
    }
    *next = s->start + (double)s->count * period;
    return 1;
}

/* State and outputs of the next sample, if the inputs are held; with `SN_MOVE` what moves them as well. */
static int sn_work_out(sn_instance *s, int how)
{
    const double *from = s->model.plant && sn_at_sample(s) ? s->saved.p : s->pending.p;
    int held;
    memcpy(s->next.p, from, (size_t)s->next.n * sizeof(double));
    if (!sn_awaits(s))
        return 1;
    memcpy(s->next_state.p, from + s->pending.n, (size_t)s->state.n * sizeof(double));
    held = s->looked;
    s->looked = 0; /* nothing of a step that fails */
    if (!sn_worked(s, how))
        return 0;
    s->looked = held | SN_WORKED_OUT;
    return 1;
}

/* The outputs of the next sample, if the inputs are held. */
static int sn_look_ahead(sn_instance *s)
{
    const sn_model *m = &s->model;
    double *shown = s->outputs.p + s->next.n;
    if (s->looked & SN_SHOWN)
        return 1;
    if (!(s->looked & SN_WORKED_OUT) && !sn_work_out(s, SN_LOOK))
        return 0;
    for (uint32_t i = 0; i < m->next; i++) {
        shown[i] = sn_limited(s, i, s->next.p[i]);
        if (!sn_finite(s->next.p[i])) {
            sn_say(s, SN_FAIL, "%.80s becomes %f: the model diverges.", m->ports[m->n_in + s->next.n + i].name, s->next.p[i]);
            return 0;
        }
    }
    s->looked |= SN_SHOWN;
    return 1;
}

/* Limit what a sample on the way to the horizon gives, as a step does; 0 where the model diverges. A limited output
 * stays where it is, whatever moves the inputs. */
static int sn_check_far(sn_instance *s)
{
    for (uint32_t i = 0; i < (uint32_t)s->far.n; i++) {
        const sn_port *port = &s->model.ports[s->model.n_in + i];
        double x = s->far.p[i];
        if (sn_infinite(x) || (sn_nan(x) && !(port->flags & SN_MISSING))) {
            sn_say(s, SN_FAIL, "%.80s becomes %f within %u samples: the model diverges.", port->name, x,
                   (unsigned)s->model.horizon);
            return 0;
        }
        if (sn_is_limited(s, i, x)) {
            s->far.p[i] = sn_limited(s, i, x);
            s->far_rows.p[i] = 0.0;
        }
    }
    return 1;
}

/* The outputs at the horizon, counted from the last sample that was reached; with `SN_FAR_MOVE` what moves them as well.
 * The next sample is worked out already. Inputs are held, but what was measured: it is known of the first sample only. */
static int sn_look_far(sn_instance *s, int how)
{
    const sn_model *m = &s->model;
    size_t states = (size_t)s->state.n * sizeof(double), own = (size_t)s->far.n * sizeof(double);
    memcpy(s->far_state.p, s->looked & SN_WORKED_OUT ? s->next_state.p : s->state.p, states);
    memcpy(s->far.p, s->next.p, own);
    if (how == SN_FAR_MOVE) {
        memcpy(s->far_state_rows.p, s->state_rows.p, states);
        memcpy(s->far_rows.p, s->next_rows.p, own);
    }
    for (uint32_t i = 0; i < m->n_in; i++) {
        int measured = m->ports[i].flags & SN_MISSING;
        s->far_inputs.p[i] = measured ? sn_from_bits(0x7ff8000000000000u) : s->inputs.p[i];
        s->far_input_rows.p[i] = measured ? 0.0 : s->input_rows.p[i];
    }
    if (!sn_check_far(s))
        return 0;
    for (uint32_t k = 1; k < m->horizon; k++)
        if (!sn_worked(s, how) || !sn_check_far(s))
            return 0;
    return 1;
}

static int sn_show_far(sn_instance *s)
{
    if (s->looked & SN_FAR_SHOWN)
        return 1;
    if (!sn_look_ahead(s) || !sn_look_far(s, SN_FAR))
        return 0;
    memcpy(s->outputs.p + s->next.n + s->model.next, s->far.p, (size_t)s->model.ahead * sizeof(double));
    s->looked |= SN_FAR_SHOWN;
    return 1;
}

/* What moves `unknown` outputs, where `known` inputs are moved by `seeds`. All but the outputs of later samples stay:
 * an input that is set shows in none of them before a communication step. */
static int sn_derivative(sn_instance *s, const uint32_t *unknown, size_t n, const uint32_t *known, size_t n_known,
                         const double *seeds, double *moved)
{
    const sn_model *m = &s->model;
    uint32_t first = m->n_in + (uint32_t)s->next.n, far = first + m->next;
    int reached = 0;
    if (m->next == 0) {
        sn_say(s, SN_FAIL, "this FMU was built without derivatives (softneck fmu --sensitivities).");
        return 0;
    }
    if (!sn_initialise(s))
        return 0;
    memset(s->state_rows.p, 0, (size_t)(s->state.n + m->n_in + s->next.n) * sizeof(double));
    for (size_t i = 0; i < n_known; i++) {
        if (known[i] >= m->n_in || (m->ports[known[i]].flags & SN_BOOLEAN) || !sn_finite(seeds[i])) {
            sn_say(s, SN_FAIL, "variable %u: derivatives are by inputs that are numbers, with finite seeds.",
                   (unsigned)known[i]);
            return 0;
        }
        s->input_rows.p[known[i]] += seeds[i];
    }
    if (!sn_work_out(s, SN_MOVE))
        return 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t own = unknown[i] - (unknown[i] < far ? first : far);
        if (unknown[i] < m->n_in || unknown[i] >= m->n_in + m->n_out) {
            sn_say(s, SN_FAIL, "variable %u: derivatives are of outputs.", (unsigned)unknown[i]);
            return 0;
        }
        if (unknown[i] >= far) {
            if (!reached && !sn_look_far(s, SN_FAR_MOVE))
                return 0;
            reached = 1;
            moved[i] = s->far_rows.p[own];
        } else if (unknown[i] < first || sn_is_limited(s, own, s->next.p[own])) {
            moved[i] = 0.0;
        } else {
            moved[i] = s->next_rows.p[own];
        }
    }
    return 1;
}

static void sn_warn_outside(sn_instance *s, uint32_t i, double value)
{
    const sn_port *port = &s->model.ports[i];
    size_t n = strlen(port->name);
    /* A set-point just outside of what was trained is in rad all the same. */
    int beyond = fabs(value) > 2.0 * (port->high > -port->low ? port->high : -port->low);
    int asked = (n > 10 && strcmp(port->name + n - 10, "_reference") == 0) ||
                (strstr(port->name, "_setpoint") != NULL && beyond);
    int angle = asked && strcmp(port->unit, "rad") == 0;
    if (s->warned[i])
        return;
    s->warned[i] = 1;
    sn_say(s, SN_WARN, "%.80s = %g is outside %g to %g %.20s.%s", port->name, value, port->low, port->high, port->unit,
           angle ? " Is it in degrees?" : "");
}

/* What is not a number within its limits for an input. */
SN_APART static int sn_set_rarely(sn_instance *s, uint32_t i, double value)
{
    const sn_port *port;
    double slack = 1e-9 * (1.0 + fabs(value)); /* a limit that a controller works out may miss by rounding */
    uint32_t known = s->model.n_in + s->model.n_out;
    int outside;
    if (i >= known + s->model.n_par) {
        sn_say(s, SN_FAIL, "there is no variable %u.", (unsigned)i);
        return 0;
    }
    port = &s->model.ports[i];
    if (!sn_finite(value) && !((port->flags & SN_MISSING) && sn_nan(value))) {
        sn_say(s, SN_FAIL, "%.80s was set to %f; it must be finite.", port->name, value);
        return 0;
    }
    outside = (value < port->low - slack || value > port->high + slack);
    if (i < s->model.n_in) {
        if (outside)
            sn_warn_outside(s, i, value);
    } else if (i < known) {
        sn_say(s, SN_FAIL, "%.80s is an output and cannot be set.", port->name);
        return 0;
    } else if (s->running && !(port->flags & SN_TUNABLE)) {
        sn_say(s, SN_FAIL, "%.80s is fixed; set it before the initialisation ends.", port->name);
        return 0;
    } else if (outside) {
        sn_say(s, SN_FAIL, "%.80s must be between %g and %g [%.20s]; it was set to %g.", port->name, port->low,
               port->high, port->unit, value);
        return 0;
    } else if (!s->running) {
        s->stale = 1;
    } else if (s->seen.n > 0) { /* a sample of this event is taken anew, as for other inputs: none was like this NaN */
        s->seen.p[0] = sn_from_bits(0x7ff8000000000001u);
    }
    s->values.p[i] = value;
    s->looked = 0;
    return 1;
}

static SN_MERGED int sn_set(sn_instance *s, uint32_t i, double value)
{
    if (i < s->model.n_in && sn_finite(value) && value >= s->model.ports[i].low && value <= s->model.ports[i].high) {
        s->values.p[i] = value; /* most of what is ever set */
        s->looked = 0;
        return 1;
    }
    return sn_set_rarely(s, i, value);
}

/* Work out an output of a later sample; other variables are there. */
static int sn_look_for(sn_instance *s, uint32_t i)
{
    uint32_t end = s->model.n_in + s->model.n_out, far = end - s->model.ahead;
    if (i >= end || i < far - s->model.next)
        return 1;
    return i < far ? sn_look_ahead(s) : sn_show_far(s);
}

/* What is not an output of now. */
SN_APART static int sn_get_rarely(sn_instance *s, uint32_t i, double *value)
{
    if ((int64_t)i >= s->values.n) {
        sn_say(s, SN_FAIL, "there is no variable %u.", (unsigned)i);
        return 0;
    }
    if (!sn_initialise(s) || !sn_look_for(s, i))
        return 0;
    *value = s->values.p[i];
    /* An input that was never set shows its start value: hosts expect a number. */
    if (i < s->model.n_in && sn_nan(*value))
        *value = s->model.ports[i].start;
    return 1;
}

static SN_MERGED int sn_get(sn_instance *s, uint32_t i, double *value)
{
    if (!s->stale && i >= s->model.n_in && i < s->model.n_in + (uint32_t)s->pending.n) {
        *value = s->values.p[i]; /* most of what is ever got */
        return 1;
    }
    return sn_get_rarely(s, i, value);
}

/* Inside all numbers are doubles, which carry whole ones up to 2^53. */
static int sn_is_integer(sn_instance *s, uint32_t i)
{
    int whole = (int64_t)i < s->values.n && (s->model.ports[i].flags & SN_INTEGER);
    if (!whole)
        sn_say(s, SN_FAIL, "variable %u is no integer.", (unsigned)i);
    return whole;
}

static int sn_get_integer(sn_instance *s, uint32_t i, int32_t *value)
{
    double x;
    if (!sn_is_integer(s, i) || !sn_get(s, i, &x))
        return 0;
    *value = (int32_t)(x < -2147483648.0 ? -2147483648.0 : x > 2147483647.0 ? 2147483647.0 : x);
    return 1;
}

static int sn_set_integer(sn_instance *s, uint32_t i, int32_t value)
{
    return sn_is_integer(s, i) && sn_set(s, i, (double)value);
}

/* The whole state, to the bit: values, pending outputs and state vector stand behind each other, and in Model Exchange
 * what the sample of this event was taken from. */
static size_t sn_snapshot_bytes(const sn_instance *s)
{
    return (size_t)(s->values.n + s->pending.n + s->state.n + s->saved.n + s->seen.n) * sizeof(double);
}

static sn_snapshot *sn_take_snapshot(sn_instance *s, sn_snapshot *into)
{
    if (!sn_initialise(s))
        return NULL;
    if (into == NULL)
        into = (sn_snapshot *)malloc(sizeof *into + sn_snapshot_bytes(s));
    if (into == NULL) {
        sn_say(s, SN_FAIL, "no memory for a state.");
        return NULL;
    }
    into->start = s->start;
    into->time = s->time;
    into->count = s->count;
    into->running = s->running;
    into->event = s->event;
    into->sampled = s->sampled;
    into->instant = s->instant;
    into->first = s->first;
    into->rounds = s->rounds;
    memcpy(into->values, s->values.p, sn_snapshot_bytes(s));
    return into;
}

static void sn_go_back(sn_instance *s, const sn_snapshot *from)
{
    s->start = from->start;
    s->time = from->time;
    s->count = from->count;
    s->running = (int)from->running;
    s->event = (int)from->event;
    s->sampled = (int)from->sampled;
    s->instant = from->instant;
    s->first = from->first;
    s->rounds = from->rounds;
    memcpy(s->values.p, from->values, sn_snapshot_bytes(s));
    s->stale = 0;
    s->looked = 0;
}

/* Serialised: magic, size, CRC-32, GUID (40), the snapshot. */
#define SN_SERIAL_HEAD 64

static size_t sn_serial_bytes(const sn_instance *s) { return SN_SERIAL_HEAD + sizeof(sn_snapshot) + sn_snapshot_bytes(s); }

static void sn_serialise(const sn_instance *s, const sn_snapshot *from, unsigned char *to)
{
    uint64_t size = sn_serial_bytes(s);
    size_t named = strlen(s->model.guid);
    uint32_t crc;
    memset(to, 0, SN_SERIAL_HEAD);
    memcpy(to, "SNSTATE2", 8);
    memcpy(to + 8, &size, 8);
    memcpy(to + 24, s->model.guid, named < 39 ? named : 39);
    memcpy(to + SN_SERIAL_HEAD, from, (size_t)size - SN_SERIAL_HEAD);
    crc = sn_crc32(to + 24, (size_t)size - 24);
    memcpy(to + 16, &crc, 4);
}

static sn_snapshot *sn_deserialise(sn_instance *s, const unsigned char *from, size_t size)
{
    sn_snapshot *made;
    uint64_t stated = 0;
    uint32_t crc = 0;
    char guid[40] = "";
    size_t named = strlen(s->model.guid);
    memcpy(guid, s->model.guid, named < 39 ? named : 39);
    if (size == sn_serial_bytes(s)) {
        memcpy(&stated, from + 8, 8);
        memcpy(&crc, from + 16, 4);
    }
    if (stated != size || size == 0 || memcmp(from, "SNSTATE2", 8) != 0 || memcmp(from + 24, guid, 40) != 0
        || crc != sn_crc32(from + 24, size - 24)) {
        sn_say(s, SN_FAIL, "the FMU state comes from another FMU or is damaged.");
        return NULL;
    }
    made = (sn_snapshot *)malloc(size - SN_SERIAL_HEAD);
    if (made == NULL) {
        sn_say(s, SN_FAIL, "no memory for a state.");
        return NULL;
    }
    memcpy(made, from + SN_SERIAL_HEAD, size - SN_SERIAL_HEAD);
    made->running = made->running != 0;
    made->event = made->event != 0;
    made->sampled = made->sampled != 0;
    if (!sn_finite(made->start) || !sn_finite(made->time) || !sn_finite(made->instant) || made->count < 0 ||
        made->count > INT64_MAX / 2 || made->first < 0 || made->first > made->count) {
        free(made);
        sn_say(s, SN_FAIL, "the FMU state is damaged.");
        return NULL;
    }
    return made;
}

/* "file:" with one to three slashes, %XX decoded; a plain path stays one. */
static int sn_path_of(const char *uri, char *path, size_t room)
{
    size_t n = 0;
    int file = strncmp(uri, "file:", 5) == 0;
    if (file) {
        uri += 5;
        if (strncmp(uri, "//localhost/", 12) == 0)
            uri += 11;
        else if (strncmp(uri, "///", 3) == 0)
            uri += 2;
#ifdef _WIN32
        if (uri[0] == '/' && uri[1] != '\0' && uri[2] == ':')
            uri++;
#endif
    }
    for (; *uri != '\0'; uri++) {
        char c = *uri;
        if (file && c == '%' && strspn(uri + 1, "0123456789abcdefABCDEF") >= 2) {
            char digits[3] = {uri[1], uri[2], '\0'};
            c = (char)strtol(digits, NULL, 16);
            uri += 2;
        }
        if (n + 1 >= room || c == '\0')
            return 0;
        path[n++] = c;
    }
    while (n > 1 && path[n - 1] == '/')
        n--;
    path[n] = '\0';
    return 1;
}

/* Make an instance from resources/model.bin; `resources` is a path. NULL where that fails; the reason was told. */
static sn_instance *sn_instantiate(int exchange, const char *resources, const char *guid, const char *name,
                                   void (*tell)(void *, int, const char *), void *environment, void *logger)
{
    char error[SN_TEXT], path[4096];
    sn_instance *s = (sn_instance *)calloc(1, sizeof *s);
    size_t n = name != NULL ? strlen(name) : 0;
    int fits;
    if (s == NULL)
        return NULL;
    s->exchange = exchange;
    s->tell = tell;
    s->environment = environment;
    s->logger = logger;
    s->instance_name = (char *)calloc(n + 1, 1);
    if (s->instance_name != NULL && n > 0)
        memcpy(s->instance_name, name, n);
    fits = snprintf(path, sizeof path, "%s/model.bin", resources != NULL ? resources : ".") < (int)sizeof path;
    if (s->instance_name == NULL || !fits) {
        sn_say(s, SN_FAIL, "the path of the resources is too long.");
    } else if (!sn_load_model(&s->model, path, error)) {
        s->model.name = NULL;
        sn_say(s, SN_FAIL, "%s", error);
    } else if (guid == NULL || strcmp(guid, s->model.guid) != 0) {
        sn_say(s, SN_FAIL, "the host's GUID %.60s is not that of the model, %.60s.", guid != NULL ? guid : "(none)",
               s->model.guid);
    } else if (sn_make_room(s)) {
        sn_restart(s);
        return s;
    } else {
        sn_say(s, SN_FAIL, "no memory, or no model of this kind.");
    }
    sn_free_instance(s);
    return NULL;
}

#endif

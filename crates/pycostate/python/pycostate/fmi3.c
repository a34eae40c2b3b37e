/* A law u(x) as an FMU: FMI 3.0 for model exchange and co-simulation. Written by costate. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "law.h"

#if defined(_WIN32)
#define FMI3 __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI3 __attribute__((visibility("default")))
#else
#define FMI3
#endif

/* Types of the standard (FMI 3.0, 2.2.2 and 2.2.3). */
typedef void *Instance;
typedef void *Environment;
typedef void *State;
typedef uint32_t Reference;
typedef const char *String;
typedef const uint8_t *Binary;
typedef enum { Ok, Warning, Discard, Error, Fatal } Status;
typedef enum { Independent, Constant, Fixed, Tunable, Discrete, Dependent } Dependency;
typedef enum { IntervalNotYetKnown, IntervalUnchanged, IntervalChanged } Interval;
typedef void (*Log)(Environment, Status, String, String);

enum { STATES = @STATES@, CONTROLS = @CONTROLS@ };

/* An instance: what it was given, and what follows. */
typedef struct {
    double t, x[STATES], u[CONTROLS];
    bool known;
} Law;

static void begin(Law *law)
{
    static const double start[STATES] = {@STARTS@};
    law->t = 0.0;
    memcpy(law->x, start, sizeof start);
    law->known = false;
}

static void compute(Law *law)
{
    const double *x = law->x;
    double *u = law->u;
    if (law->known) return;
    @CALL@
    law->known = true;
}

static Instance instance(String token)
{
    Law *law;
    if (!token || strcmp(token, "@TOKEN@") != 0) return NULL;
    law = malloc(sizeof *law);
    if (law) begin(law);
    return law;
}

FMI3 const char *fmi3GetVersion(void) { return "3.0"; }
FMI3 Status fmi3SetDebugLogging(Instance i, bool on, size_t n, const String c[])
{
    (void)i; (void)on; (void)n; (void)c;
    return Ok;
}
FMI3 Instance fmi3InstantiateModelExchange(String name, String token, String path, bool visible, bool logging,
                                           Environment environment, Log log)
{
    (void)name; (void)path; (void)visible; (void)logging; (void)environment; (void)log;
    return instance(token);
}
FMI3 Instance fmi3InstantiateCoSimulation(String name, String token, String path, bool visible, bool logging, bool events,
                                          bool early, const Reference required[], size_t count, Environment environment,
                                          Log log, void *update)
{
    (void)name; (void)path; (void)visible; (void)logging; (void)events; (void)early; (void)required; (void)count;
    (void)environment; (void)log; (void)update;
    return instance(token);
}
FMI3 Instance fmi3InstantiateScheduledExecution(String name, String token, String path, bool visible, bool logging,
                                                Environment environment, Log log, void *a, void *b, void *c)
{
    (void)name; (void)token; (void)path; (void)visible; (void)logging; (void)environment; (void)log;
    (void)a; (void)b; (void)c;
    return NULL;
}
FMI3 void fmi3FreeInstance(Instance i) { free(i); }
FMI3 Status fmi3EnterInitializationMode(Instance i, bool tolerance, double t, double start, bool ends, double stop)
{
    (void)tolerance; (void)t; (void)ends; (void)stop;
    ((Law *)i)->t = start;
    return Ok;
}
FMI3 Status fmi3Reset(Instance i)
{
    begin(i);
    return Ok;
}

/* Modes, of which a law knows nothing. */
#define MODE(name) \
    FMI3 Status name(Instance i) \
    { \
        (void)i; \
        return Ok; \
    }
MODE(fmi3ExitInitializationMode)
MODE(fmi3EnterEventMode)
MODE(fmi3Terminate)
MODE(fmi3EnterConfigurationMode)
MODE(fmi3ExitConfigurationMode)
MODE(fmi3EnterContinuousTimeMode)
MODE(fmi3EnterStepMode)
MODE(fmi3EvaluateDiscreteStates)

FMI3 Status fmi3GetFloat64(Instance i, const Reference r[], size_t n, double v[], size_t m)
{
    Law *law = i;
    size_t k;
    if (n != m) return Error;
    for (k = 0; k < n; k++) {
        if (r[k] == 0) v[k] = law->t;
        else if (r[k] <= STATES) v[k] = law->x[r[k] - 1];
        else if (r[k] <= STATES + CONTROLS) {
            compute(law);
            v[k] = law->u[r[k] - 1 - STATES];
        } else return Error;
    }
    return Ok;
}
FMI3 Status fmi3SetFloat64(Instance i, const Reference r[], size_t n, const double v[], size_t m)
{
    Law *law = i;
    size_t k;
    if (n != m) return Error;
    for (k = 0; k < n; k++) {
        if (r[k] < 1 || r[k] > STATES) return Error;
        law->x[r[k] - 1] = v[k];
        law->known = false;
    }
    return Ok;
}

/* Variables of other types: there are none. */
#define NONE(name, type) \
    FMI3 Status fmi3Get##name(Instance i, const Reference r[], size_t n, type v[], size_t m) \
    { \
        (void)i; (void)r; (void)v; \
        return n || m ? Error : Ok; \
    } \
    FMI3 Status fmi3Set##name(Instance i, const Reference r[], size_t n, const type v[], size_t m) \
    { \
        (void)i; (void)r; (void)v; \
        return n || m ? Error : Ok; \
    }
NONE(Float32, float)
NONE(Int8, int8_t)
NONE(UInt8, uint8_t)
NONE(Int16, int16_t)
NONE(UInt16, uint16_t)
NONE(Int32, int32_t)
NONE(UInt32, uint32_t)
NONE(Int64, int64_t)
NONE(UInt64, uint64_t)
NONE(Boolean, bool)
NONE(String, String)
FMI3 Status fmi3GetBinary(Instance i, const Reference r[], size_t n, size_t s[], Binary v[], size_t m)
{
    (void)i; (void)r; (void)s; (void)v;
    return n || m ? Error : Ok;
}
FMI3 Status fmi3SetBinary(Instance i, const Reference r[], size_t n, const size_t s[], const Binary v[], size_t m)
{
    (void)i; (void)r; (void)s; (void)v;
    return n || m ? Error : Ok;
}
FMI3 Status fmi3GetClock(Instance i, const Reference r[], size_t n, bool v[])
{
    (void)i; (void)r; (void)v;
    return n ? Error : Ok;
}
FMI3 Status fmi3SetClock(Instance i, const Reference r[], size_t n, const bool v[])
{
    (void)i; (void)r; (void)v;
    return n ? Error : Ok;
}

/* Each control depends on all states. */
FMI3 Status fmi3GetNumberOfVariableDependencies(Instance i, Reference r, size_t *n)
{
    (void)i;
    *n = r > STATES ? STATES : 0;
    return Ok;
}
FMI3 Status fmi3GetVariableDependencies(Instance i, Reference dependent, size_t element[], Reference independents[],
                                        size_t elements[], Dependency kinds[], size_t n)
{
    size_t k;
    (void)i;
    if (n != (dependent > STATES ? (size_t)STATES : 0)) return Error;
    for (k = 0; k < n; k++) {
        element[k] = elements[k] = 0;
        independents[k] = (Reference)(k + 1);
        kinds[k] = Dependent;
    }
    return Ok;
}

/* The whole instance is its state. */
FMI3 Status fmi3GetFMUState(Instance i, State *s)
{
    if (!*s) *s = malloc(sizeof(Law));
    if (!*s) return Error;
    memcpy(*s, i, sizeof(Law));
    return Ok;
}
FMI3 Status fmi3SetFMUState(Instance i, State s)
{
    memcpy(i, s, sizeof(Law));
    return Ok;
}
FMI3 Status fmi3FreeFMUState(Instance i, State *s)
{
    (void)i;
    free(*s);
    *s = NULL;
    return Ok;
}
FMI3 Status fmi3SerializedFMUStateSize(Instance i, State s, size_t *n)
{
    (void)i; (void)s;
    *n = sizeof(Law);
    return Ok;
}
FMI3 Status fmi3SerializeFMUState(Instance i, State s, uint8_t b[], size_t n)
{
    (void)i;
    if (n < sizeof(Law)) return Error;
    memcpy(b, s, sizeof(Law));
    return Ok;
}
FMI3 Status fmi3DeserializeFMUState(Instance i, const uint8_t b[], size_t n, State *s)
{
    (void)i;
    if (n < sizeof(Law)) return Error;
    if (!*s) *s = malloc(sizeof(Law));
    if (!*s) return Error;
    memcpy(*s, b, sizeof(Law));
    return Ok;
}

FMI3 Status fmi3GetDirectionalDerivative(Instance i, const Reference a[], size_t n, const Reference b[], size_t m,
                                         const double s[], size_t p, double d[], size_t q)
{
    (void)i; (void)a; (void)n; (void)b; (void)m; (void)s; (void)p; (void)d; (void)q;
    return Error;
}
FMI3 Status fmi3GetAdjointDerivative(Instance i, const Reference a[], size_t n, const Reference b[], size_t m,
                                     const double s[], size_t p, double d[], size_t q)
{
    return fmi3GetDirectionalDerivative(i, a, n, b, m, s, p, d, q);
}

/* Clocks: there are none. */
FMI3 Status fmi3GetIntervalDecimal(Instance i, const Reference r[], size_t n, double v[], Interval q[])
{
    (void)i; (void)r; (void)v; (void)q;
    return n ? Error : Ok;
}
FMI3 Status fmi3GetIntervalFraction(Instance i, const Reference r[], size_t n, uint64_t c[], uint64_t d[], Interval q[])
{
    (void)i; (void)r; (void)c; (void)d; (void)q;
    return n ? Error : Ok;
}
FMI3 Status fmi3GetShiftDecimal(Instance i, const Reference r[], size_t n, double v[])
{
    (void)i; (void)r; (void)v;
    return n ? Error : Ok;
}
FMI3 Status fmi3GetShiftFraction(Instance i, const Reference r[], size_t n, uint64_t c[], uint64_t d[])
{
    (void)i; (void)r; (void)c; (void)d;
    return n ? Error : Ok;
}
FMI3 Status fmi3SetIntervalDecimal(Instance i, const Reference r[], size_t n, const double v[])
{
    (void)i; (void)r; (void)v;
    return n ? Error : Ok;
}
FMI3 Status fmi3SetIntervalFraction(Instance i, const Reference r[], size_t n, const uint64_t c[], const uint64_t d[])
{
    (void)i; (void)r; (void)c; (void)d;
    return n ? Error : Ok;
}
FMI3 Status fmi3SetShiftDecimal(Instance i, const Reference r[], size_t n, const double v[])
{
    return fmi3SetIntervalDecimal(i, r, n, v);
}
FMI3 Status fmi3SetShiftFraction(Instance i, const Reference r[], size_t n, const uint64_t c[], const uint64_t d[])
{
    return fmi3SetIntervalFraction(i, r, n, c, d);
}
FMI3 Status fmi3ActivateModelPartition(Instance i, Reference r, double t)
{
    (void)i; (void)r; (void)t;
    return Error;
}

FMI3 Status fmi3UpdateDiscreteStates(Instance i, bool *again, bool *ends, bool *nominals, bool *values, bool *timed,
                                     double *next)
{
    (void)i;
    *again = *ends = *nominals = *values = *timed = false;
    *next = 0.0;
    return Ok;
}
FMI3 Status fmi3CompletedIntegratorStep(Instance i, bool kept, bool *event, bool *ends)
{
    (void)i; (void)kept;
    *event = *ends = false;
    return Ok;
}
FMI3 Status fmi3SetTime(Instance i, double t)
{
    ((Law *)i)->t = t;
    return Ok;
}

/* Continuous states and event indicators: there are none. */
#define EMPTY(name, type) \
    FMI3 Status name(Instance i, type v[], size_t n) \
    { \
        (void)i; (void)v; \
        return n ? Error : Ok; \
    }
EMPTY(fmi3SetContinuousStates, const double)
EMPTY(fmi3GetContinuousStateDerivatives, double)
EMPTY(fmi3GetEventIndicators, double)
EMPTY(fmi3GetContinuousStates, double)
EMPTY(fmi3GetNominalsOfContinuousStates, double)
FMI3 Status fmi3GetNumberOfEventIndicators(Instance i, size_t *n)
{
    (void)i;
    *n = 0;
    return Ok;
}
FMI3 Status fmi3GetNumberOfContinuousStates(Instance i, size_t *n)
{
    return fmi3GetNumberOfEventIndicators(i, n);
}
FMI3 Status fmi3GetOutputDerivatives(Instance i, const Reference r[], size_t n, const int32_t o[], double v[], size_t m)
{
    (void)i; (void)r; (void)o; (void)v;
    return n || m ? Error : Ok;
}
FMI3 Status fmi3DoStep(Instance i, double t, double step, bool kept, bool *event, bool *ends, bool *early, double *last)
{
    (void)kept;
    ((Law *)i)->t = *last = t + step;
    *event = *ends = *early = false;
    return Ok;
}

/* Time a Co-Simulation FMU of FMI 2.0 as a controller board would run it: set, step, get, and no Python.
 *
 *     native_cost LIBRARY RESOURCES GUID STEP N_SET N_GET N_AHEAD ROWS  < value references, then ROWS inputs of N_SET doubles
 *
 * The first N_AHEAD of what is got are also derived, by the first input. Prints nanoseconds of processor time: a cycle, a
 * cycle with its derivative; medians over stretches of a hundred cycles. */
#define _POSIX_C_SOURCE 200809L
#include <dlfcn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { STRETCH = 100, STRETCHES = 60 };
typedef struct { void *logger, *allocate, *release, *finished, *environment; } callbacks;

static void report(void *e, const char *name, int status, const char *category, const char *text, ...)
{
    (void)e, (void)name, (void)status, (void)category;
    fprintf(stderr, "%s\n", text);
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static int upwards(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
    callbacks calls = {(void *)report, (void *)calloc, (void *)free, NULL, NULL};
    void *library, *fmu;
    if (argc != 9 || (library = dlopen(argv[1], RTLD_NOW)) == NULL)
        return 2;
    double step = atof(argv[4]), time = 0.0, took[STRETCHES], values[64], seed = 1.0, moved[8];
    size_t n_set = (size_t)atoi(argv[5]), n_get = (size_t)atoi(argv[6]), n_ahead = (size_t)atoi(argv[7]);
    size_t rows = (size_t)atoi(argv[8]), k = 0;
    unsigned references[128];
    double *inputs = malloc((rows * n_set + 1) * sizeof *inputs);
    if (inputs == NULL || n_set + n_get > 128 || n_get > 64 || n_ahead > 8)
        return 2;
    if (fread(references, sizeof *references, n_set + n_get, stdin) != n_set + n_get
        || fread(inputs, sizeof *inputs, rows * n_set, stdin) != rows * n_set)
        return 2;
    void *(*make)(const char *, int, const char *, const char *, void *, int, int) = dlsym(library, "fmi2Instantiate");
    int (*setup)(void *, int, double, double, int, double) = dlsym(library, "fmi2SetupExperiment");
    int (*enter)(void *) = dlsym(library, "fmi2EnterInitializationMode");
    int (*leave)(void *) = dlsym(library, "fmi2ExitInitializationMode");
    int (*set)(void *, const unsigned *, size_t, const double *) = dlsym(library, "fmi2SetReal");
    int (*get)(void *, const unsigned *, size_t, double *) = dlsym(library, "fmi2GetReal");
    int (*advance)(void *, double, double, int) = dlsym(library, "fmi2DoStep");
    int (*derive)(void *, const unsigned *, size_t, const unsigned *, size_t, const double *, double *) =
        dlsym(library, "fmi2GetDirectionalDerivative");
    fmu = make("host", 1, argv[3], argv[2], &calls, 0, 0);
    if (fmu == NULL || setup(fmu, 0, 0.0, 0.0, 0, 0.0) != 0 || enter(fmu) != 0 || leave(fmu) != 0)
        return 3;
    for (int derived = 0; derived < (n_ahead > 0 ? 2 : 1); derived++) {
        for (int s = 0; s < STRETCHES; s++) {
            double begin = now();
            for (int i = 0; i < STRETCH; i++, k++, time += step)
                if ((n_set > 0 && set(fmu, references, n_set, inputs + (k % rows) * n_set) != 0)
                    || (derived && derive(fmu, references + n_set, n_ahead, references, 1, &seed, moved) != 0)
                    || advance(fmu, time, step, 1) != 0
                    || get(fmu, references + n_set + n_ahead, n_get - n_ahead, values) != 0)
                    return 4;
            took[s] = (now() - begin) / STRETCH;
        }
        qsort(took, STRETCHES, sizeof *took, upwards);
        printf("%.2f\n", took[STRETCHES / 2]);
    }
    free(inputs);
    return 0;
}

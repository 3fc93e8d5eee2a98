/* Load a compiled FMU's library, step it through rows of inputs, print every bit of its outputs.
 *
 *     native_host LIBRARY RESOURCES GUID N_IN N_OUT STEP ROWS < inputs (doubles) > outputs (doubles)
 *
 * Cross-compiled by zig for `make nightly`: the same program under wine, qemu and here. Booleans go as Booleans: bit i of
 * the masks in the environment (IN_BOOLEANS, OUT_BOOLEANS, as decimal numbers). */
#include <stdio.h>
#include <stdlib.h>
#include <stdarg.h>
#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#include <windows.h>
#define LOAD(path) ((void *)LoadLibraryA(path))
#define FIND(library, name) ((void *)GetProcAddress((HMODULE)library, name))
#else
#include <dlfcn.h>
#define LOAD(path) dlopen(path, RTLD_NOW)
#define FIND(library, name) dlsym(library, name)
#endif

typedef struct { void *logger, *allocate, *release, *finished, *environment; } callbacks;

static void report(void *e, const char *name, int status, const char *category, const char *text, ...)
{
    (void)e, (void)name, (void)status, (void)category;
    fprintf(stderr, "%s\n", text);
}

int main(int argc, char **argv)
{
    void *library, *fmu;
    callbacks calls = {(void *)report, NULL, NULL, NULL, NULL};
    if (argc < 8 || (library = LOAD(argv[1])) == NULL) {
        fprintf(stderr, "cannot load the library\n");
        return 2;
    }
#ifdef _WIN32
    _setmode(_fileno(stdin), _O_BINARY);
    _setmode(_fileno(stdout), _O_BINARY);
#endif
    int n_in = atoi(argv[4]), n_out = atoi(argv[5]), rows = atoi(argv[7]);
    double step = atof(argv[6]);
    unsigned long long in = strtoull(getenv("IN_BOOLEANS"), NULL, 10), out = strtoull(getenv("OUT_BOOLEANS"), NULL, 10);
    void *(*make)(const char *, int, const char *, const char *, void *, int, int) = FIND(library, "fmi2Instantiate");
    int (*setup)(void *, int, double, double, int, double) = FIND(library, "fmi2SetupExperiment");
    int (*leave)(void *) = FIND(library, "fmi2ExitInitializationMode");
    int (*set)(void *, const unsigned *, size_t, const double *) = FIND(library, "fmi2SetReal");
    int (*set_boolean)(void *, const unsigned *, size_t, const int *) = FIND(library, "fmi2SetBoolean");
    int (*get)(void *, const unsigned *, size_t, double *) = FIND(library, "fmi2GetReal");
    int (*advance)(void *, double, double, int) = FIND(library, "fmi2DoStep");
    fmu = make("host", 1, argv[3], argv[2], &calls, 0, 0);
    if (fmu == NULL || setup(fmu, 0, 0.0, 0.0, 0, 0.0) != 0 || leave(fmu) != 0)
        return 3;
    (void)out;
    for (int k = 0; k < rows; k++) {
        for (unsigned i = 0; i < (unsigned)n_in; i++) {
            double x;
            int flag;
            if (fread(&x, sizeof x, 1, stdin) != 1)
                return 4;
            flag = x > 0.5;
            if ((in >> i & 1 ? set_boolean(fmu, &i, 1, &flag) : set(fmu, &i, 1, &x)) != 0)
                return 5;
        }
        if (advance(fmu, k * step, step, 1) != 0)
            return 6;
        for (unsigned i = 0; i < (unsigned)n_out; i++) {
            unsigned reference = (unsigned)n_in + i;
            double y;
            if (get(fmu, &reference, 1, &y) != 0)
                return 7;
            fwrite(&y, sizeof y, 1, stdout);
        }
    }
    return 0;
}

/* A loop's SSP file in libcosim or ecos from a program that is no Python, so that nothing but the FMUs can bring one.
 *
 *     cc -std=c99 -o host host.c -ldl
 *     ./host libcosim|ecos LIBRARY SSP STEP ROWS PART::VARIABLE... > rows of doubles
 *
 * Ends with 9 where a file whose name holds "python" is mapped when the last row is there (Linux tells). The functions are
 * those that the Python bindings of both call; neither wheel has a header. */
#include <dlfcn.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST 64
#define MOST_VARIABLES 500
typedef struct { char name[1024]; int index; } slave_info;
typedef struct { char name[1024]; uint32_t reference; int type, causality, variability; } variable_info;

static void *library;

static void *find(const char *name)
{
    void *found = dlsym(library, name);
    if (found == NULL) {
        fprintf(stderr, "%s is not there\n", name);
        exit(2);
    }
    return found;
}

static int has_python(void)
{
    char line[4096];
    FILE *maps = fopen("/proc/self/maps", "r");
    int seen = 0, lines = 0;
    while (maps != NULL && fgets(line, sizeof line, maps) != NULL) {
        const char *file = strrchr(line, '/');
        lines++;
        if (file != NULL && strstr(file, "python") != NULL)
            seen = fprintf(stderr, "%s", line);
    }
    return seen || lines == 0;
}

static int in_ecos(const char *ssp, double step, int rows, int n, char **names)
{
    void *(*create)(const char *, double) = find("ecos_simulation_create_from_ssp");
    bool (*init)(void *, double, const char *) = find("ecos_simulation_init");
    double (*advance)(void *, size_t) = find("ecos_simulation_step");
    bool (*get)(void *, const char *, double *) = find("ecos_simulation_get_real");
    void *simulation = create(ssp, step);
    if (simulation == NULL || !init(simulation, 0.0, "initialValues"))
        return 3;
    for (int k = 0; k < rows; k++) {
        if (k > 0)
            (void)advance(simulation, 1);
        for (int i = 0; i < n; i++) {
            double x = 0.0;
            if (!get(simulation, names[i], &x))
                return 4;
            fwrite(&x, sizeof x, 1, stdout);
        }
    }
    return has_python() ? 9 : 0;
}

/* Fill in the number of the part and the reference of its variable; 0 where there is none. */
static int place(void *execution, const char *name, int *slave, uint32_t *reference)
{
    size_t (*count)(void *) = find("cosim_execution_get_num_slaves");
    int (*slaves)(void *, slave_info *, size_t) = find("cosim_execution_get_slave_infos");
    int (*variables)(void *, int, variable_info *, size_t) = find("cosim_slave_get_variables");
    static slave_info parts[MOST];
    static variable_info known[MOST_VARIABLES];
    const char *variable = strstr(name, "::") + 2;
    size_t length = (size_t)(variable - name) - 2, n = count(execution);
    if (n > MOST || slaves(execution, parts, n) != 0)
        return 0;
    for (size_t i = 0; i < n; i++) {
        if (strlen(parts[i].name) != length || strncmp(parts[i].name, name, length) != 0)
            continue;
        int found = variables(execution, parts[i].index, known, MOST_VARIABLES);
        for (int j = 0; j < found; j++) {
            if (strcmp(known[j].name, variable) == 0) {
                *slave = parts[i].index;
                *reference = known[j].reference;
                return 1;
            }
        }
    }
    return 0;
}

static int in_libcosim(const char *ssp, double step, int rows, int n, char **names)
{
    void *(*create)(const char *, bool, int64_t, int64_t) = find("cosim_ssp_fixed_step_execution_create");
    void *(*observe)(void) = find("cosim_last_value_observer_create");
    int (*add)(void *, void *) = find("cosim_execution_add_observer");
    int (*advance)(void *, size_t) = find("cosim_execution_step");
    int (*get)(void *, int, const uint32_t *, size_t, double *) = find("cosim_observer_slave_get_real");
    void *execution = create(ssp, false, 0, (int64_t)(step * 1e9 + 0.5)), *observer = observe();
    int slaves[MOST];
    uint32_t references[MOST];
    if (execution == NULL || n > MOST || add(execution, observer) != 0)
        return 3;
    for (int i = 0; i < n; i++)
        if (!place(execution, names[i], &slaves[i], &references[i]))
            return 4;
    for (int k = 0; k < rows; k++) {
        if (k > 0 && advance(execution, 1) != 0)
            return 5;
        for (int i = 0; i < n; i++) {
            double x = 0.0; /* before its first step this observer has nothing */
            if (k > 0 && get(observer, slaves[i], &references[i], 1, &x) != 0)
                return 6;
            fwrite(&x, sizeof x, 1, stdout);
        }
    }
    return has_python() ? 9 : 0;
}

int main(int argc, char **argv)
{
    if (argc < 7 || (library = dlopen(argv[2], RTLD_NOW)) == NULL) {
        fprintf(stderr, "cannot load the master: %s\n", argc < 7 ? "too few arguments" : dlerror());
        return 2;
    }
    int (*run)(const char *, double, int, int, char **) = strcmp(argv[1], "ecos") == 0 ? in_ecos : in_libcosim;
    int code = run(argv[3], atof(argv[4]), atoi(argv[5]), argc - 6, argv + 6);
    fflush(stdout);
    _Exit(code); /* what the masters do at the end is none of ours */
}

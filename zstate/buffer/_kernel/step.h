/* Steps: one edge of a path each, for zstate/buffer/cells.py and steps.py. */

#define PI 3.14159265358979323846
#define TAU 6.28318530717958647693

typedef enum { FIXED, HINGE, SLIDE, PLANAR, GIVEN, STEP_KINDS } StepKind;

/* How many numbers a step of each kind has, and how many columns of a row it reads. */
static const Py_ssize_t step_numbers[STEP_KINDS] = {7, 13, 12, 7, 7};
static const Py_ssize_t step_columns[STEP_KINDS] = {0, 1, 1, 3, 7};

typedef struct {
    StepKind kind;
    bool turns; /* the angle is a continuous joint's */
    Py_ssize_t use;
    Py_ssize_t column;
    double scale, shift;
    double q_cos[4], q_sin[4];
    double t0[3], t1[3];
    Pose origin;    /* of fixed, planar and given steps; fixed ones have nothing else */
    bool at_origin; /* the origin is the identity */
} Step;

/* The rows around an instant in one track; a == b for an exact hit. */
typedef struct {
    const double *a;
    const double *b;
    double ratio;
} Between;

static inline double
line_between(double a, double b, double ratio)
{
    return a + ratio * (b - a);
}

static inline double
turn_between(double a, double b, double ratio)
{
    double way = b - a;
    if (fabs(way) > PI && fabs(a) <= PI && fabs(b) <= PI)
        way = way > 0.0 ? way - TAU : way + TAU;
    return a + ratio * way;
}

/* scale * joint + shift */
static inline double
travel(const Step *step, const Between *now)
{
    double a = now->a[step->column], b = now->b[step->column];
    double value = step->turns ? turn_between(a, b, now->ratio) : line_between(a, b, now->ratio);
    return step->scale * value + step->shift;
}

static inline Pose
hinge_pose(const Step *step, double angle)
{
    const double *a = step->q_cos, *b = step->q_sin;
    double half = 0.5 * angle, c = cos(half), s = sin(half);
    return (Pose){step->t0[0],         step->t0[1],         step->t0[2],        a[0] * c + b[0] * s,
                  a[1] * c + b[1] * s, a[2] * c + b[2] * s, a[3] * c + b[3] * s};
}

static inline Pose
slide_pose(const Step *step, double n)
{
    return (Pose){step->t0[0] + step->t1[0] * n,
                  step->t0[1] + step->t1[1] * n,
                  step->t0[2] + step->t1[2] * n,
                  step->q_cos[0],
                  step->q_cos[1],
                  step->q_cos[2],
                  step->q_cos[3]};
}

static Pose
planar_pose(const Step *step, const Between *now)
{
    const double *a = now->a + step->column, *b = now->b + step->column;
    double x = line_between(a[0], b[0], now->ratio), y = line_between(a[1], b[1], now->ratio);
    double half = 0.5 * turn_between(a[2], b[2], now->ratio);
    return compose(step->origin, (Pose){x, y, 0.0, 0.0, 0.0, sin(half), cos(half)});
}

static Pose
given_pose(const Step *step, const Between *now)
{
    Pose given = pose_between(now->a + step->column, now->b + step->column, now->ratio);
    return step->at_origin ? given : compose(step->origin, given);
}

static inline Pose
step_pose(const Step *step, const Between *nows)
{
    switch (step->kind) {
    case HINGE:
        return hinge_pose(step, travel(step, &nows[step->use]));
    case SLIDE:
        return slide_pose(step, travel(step, &nows[step->use]));
    case PLANAR:
        return planar_pose(step, &nows[step->use]);
    case GIVEN:
        return given_pose(step, &nows[step->use]);
    default:
        return step->origin;
    }
}

/* top_from_bottom; the identity of no steps. */
static Pose
chain_pose(const Step *steps, Py_ssize_t count, const Between *nows)
{
    if (count == 0)
        return identity;
    Pose pose = step_pose(&steps[0], nows);
    for (Py_ssize_t i = 1; i < count; i++)
        pose = compose(pose, step_pose(&steps[i], nows));
    return pose;
}

/* From (kind, use, column, turns, numbers). Uses and columns are checked by check_step. */
static int
read_step(PyObject *description, Step *step)
{
    int kind, turns;
    PyObject *tuple;
    double n[13];
    memset(step, 0, sizeof(*step));
    if (!PyTuple_Check(description)) {
        PyErr_SetString(PyExc_TypeError, "a step is a tuple (kind, use, column, turns, numbers)");
        return -1;
    }
    if (!PyArg_ParseTuple(description, "innpO:step", &kind, &step->use, &step->column, &turns,
                          &tuple))
        return -1;
    if (kind < 0 || kind >= STEP_KINDS) {
        PyErr_Format(PyExc_ValueError, "there is no step of kind %d", kind);
        return -1;
    }
    if (read_doubles(tuple, n, step_numbers[kind]) < 0)
        return -1;
    step->kind = (StepKind)kind;
    step->turns = turns != 0;
    if (kind == HINGE || kind == SLIDE) {
        step->scale = n[0];
        step->shift = n[1];
        memcpy(step->q_cos, n + 2, sizeof(step->q_cos));
        memcpy(step->t0, n + 6, sizeof(step->t0));
        memcpy(kind == HINGE ? step->q_sin : step->t1, n + 9,
               (kind == HINGE ? 4 : 3) * sizeof(double));
        return 0;
    }
    step->origin = (Pose){n[0], n[1], n[2], n[3], n[4], n[5], n[6]};
    step->at_origin = memcmp(&step->origin, &identity, sizeof(identity)) == 0;
    return 0;
}

static int
check_step(const Step *step, Py_ssize_t use_count, const Py_ssize_t *widths)
{
    if (step->kind == FIXED)
        return 0;
    if (step->use >= 0 && step->use < use_count && step->column >= 0 &&
        step->column <= widths[step->use] - step_columns[step->kind])
        return 0;
    PyErr_Format(PyExc_ValueError, "a step reads column %zd of track %zd, which is not there",
                 step->column, step->use);
    return -1;
}

/* Steps: one edge of a path each, for zstate/buffer/interpolation.py. */

#define PI 3.14159265358979323846
#define TAU 6.28318530717958647693

typedef enum {
    STEP_STATIC,
    STEP_REVOLUTE,
    STEP_PRISMATIC,
    STEP_PLANAR,
    STEP_POSE,
    STEP_KINDS
} StepKind;

/* The number of numbers of a step of each kind, and of columns of a row that it reads. */
static const Py_ssize_t step_numbers[STEP_KINDS] = {7, 13, 12, 7, 7};
static const Py_ssize_t step_columns[STEP_KINDS] = {0, 1, 1, 3, 7};

typedef struct {
    StepKind kind;
    bool is_angle; /* the angle is a continuous joint's */
    Py_ssize_t use;
    Py_ssize_t column;
    double scale, shift;
    double q_cos[4], q_sin[4];
    double t0[3], t1[3];
    Pose origin;    /* of static, planar and pose steps; static ones have nothing else */
    bool at_origin; /* the origin is the identity */
} Step;

/* The rows around an instant in one track; a == b for an exact hit. */
typedef struct {
    const double *a;
    const double *b;
    double ratio;
} Bracket;

static inline double
interpolate_linear(double a, double b, double ratio)
{
    return a + ratio * (b - a);
}

/* Angles within [-pi, pi] more than half a turn apart are of a wrapped encoder, and take the short
 * way: the same rule as ContinuousAngleInterpolator in interpolation.py. */
static inline double
angle_difference(double a, double b)
{
    double difference = b - a;
    if (fabs(difference) > PI && fabs(a) <= PI && fabs(b) <= PI)
        return difference > 0.0 ? difference - TAU : difference + TAU;
    return difference;
}

static inline double
interpolate_angle(double a, double b, double ratio)
{
    return a + ratio * angle_difference(a, b);
}

/* scale * joint + shift */
static inline double
joint_value(const Step *step, const Bracket *now)
{
    double a = now->a[step->column], b = now->b[step->column];
    double value =
        step->is_angle ? interpolate_angle(a, b, now->ratio) : interpolate_linear(a, b, now->ratio);
    return step->scale * value + step->shift;
}

/* Turned by twice the angle of cosine c and sine s. */
static inline Pose
turned_pose(const Step *step, double c, double s)
{
    const double *a = step->q_cos, *b = step->q_sin;
    return (Pose){step->t0[0],         step->t0[1],         step->t0[2],        a[0] * c + b[0] * s,
                  a[1] * c + b[1] * s, a[2] * c + b[2] * s, a[3] * c + b[3] * s};
}

static inline Pose
revolute_pose(const Step *step, double angle)
{
    double half = 0.5 * angle;
    return turned_pose(step, cos(half), sin(half));
}

static inline Pose
prismatic_pose(const Step *step, double n)
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
planar_pose(const Step *step, const Bracket *now)
{
    const double *a = now->a + step->column, *b = now->b + step->column;
    double x = interpolate_linear(a[0], b[0], now->ratio);
    double y = interpolate_linear(a[1], b[1], now->ratio);
    double half = 0.5 * interpolate_angle(a[2], b[2], now->ratio);
    return compose(step->origin, (Pose){x, y, 0.0, 0.0, 0.0, sin(half), cos(half)});
}

static Pose
sampled_pose(const Step *step, const Bracket *now)
{
    Pose sampled = interpolate_pose(now->a + step->column, now->b + step->column, now->ratio);
    return step->at_origin ? sampled : compose(step->origin, sampled);
}

static inline Pose
step_pose(const Step *step, const Bracket *nows)
{
    switch (step->kind) {
    case STEP_REVOLUTE:
        return revolute_pose(step, joint_value(step, &nows[step->use]));
    case STEP_PRISMATIC:
        return prismatic_pose(step, joint_value(step, &nows[step->use]));
    case STEP_PLANAR:
        return planar_pose(step, &nows[step->use]);
    case STEP_POSE:
        return sampled_pose(step, &nows[step->use]);
    default:
        return step->origin;
    }
}

/* top_from_bottom; the identity of no steps. */
static Pose
chain_pose(const Step *steps, Py_ssize_t count, const Bracket *nows)
{
    if (count == 0)
        return identity;
    Pose pose = step_pose(&steps[0], nows);
    for (Py_ssize_t i = 1; i < count; i++)
        pose = compose(pose, step_pose(&steps[i], nows));
    return pose;
}

/* From (kind, use, column, is_angle, numbers). Uses and columns are checked by check_step. */
static int
read_step(PyObject *description, Step *step)
{
    int kind, is_angle;
    PyObject *tuple;
    double n[13];
    memset(step, 0, sizeof(*step));
    if (!PyTuple_Check(description)) {
        PyErr_SetString(PyExc_TypeError,
                        "a step is a tuple (kind, use, column, is_angle, numbers)");
        return -1;
    }
    if (!PyArg_ParseTuple(description, "innpO:step", &kind, &step->use, &step->column, &is_angle,
                          &tuple))
        return -1;
    if (kind < 0 || kind >= STEP_KINDS) {
        PyErr_Format(PyExc_ValueError, "there is no step of kind %d", kind);
        return -1;
    }
    if (read_doubles(tuple, n, step_numbers[kind]) < 0)
        return -1;
    step->kind = (StepKind)kind;
    step->is_angle = is_angle != 0;
    if (kind == STEP_REVOLUTE || kind == STEP_PRISMATIC) {
        step->scale = n[0];
        step->shift = n[1];
        memcpy(step->q_cos, n + 2, sizeof(step->q_cos));
        memcpy(step->t0, n + 6, sizeof(step->t0));
        memcpy(kind == STEP_REVOLUTE ? step->q_sin : step->t1, n + 9,
               (kind == STEP_REVOLUTE ? 4 : 3) * sizeof(double));
        return 0;
    }
    step->origin = (Pose){n[0], n[1], n[2], n[3], n[4], n[5], n[6]};
    step->at_origin = memcmp(&step->origin, &identity, sizeof(identity)) == 0;
    return 0;
}

static int
check_step(const Step *step, Py_ssize_t use_count, const Py_ssize_t *widths)
{
    if (step->kind == STEP_STATIC)
        return 0;
    if (step->use >= 0 && step->use < use_count && step->column >= 0 &&
        step->column <= widths[step->use] - step_columns[step->kind])
        return 0;
    PyErr_Format(PyExc_ValueError, "a step reads column %zd of track %zd, which is not there",
                 step->column, step->use);
    return -1;
}

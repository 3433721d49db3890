/* Path: a compiled path between two frames, for zstate/buffer/path.py. */

typedef struct {
    PyObject_HEAD
    PyTypeObject *type; /* of the results: Transform, which derives from TransformFields */
    PyObject *target;
    PyObject *source;
    PyObject *histories; /* a tuple: of the tracks of the path */
    Step *steps;         /* those to the target, then those to the source */
    Py_ssize_t to_target;
    Py_ssize_t to_source;
} Path;

static PyTypeObject Path_type;

/* One track as a path sees it during one call. */
typedef struct {
    const Block *block;
    Py_ssize_t first;
    Py_ssize_t end;
    Py_ssize_t near; /* of a batch: the sample at or after its last instant */
} Window;

/* A path over more tracks than this needs memory from the heap in its calls. */
#define FEW_TRACKS 16

static Py_ssize_t
track_count(const Path *self)
{
    return PyTuple_GET_SIZE(self->histories);
}

static inline Window
window_of(const Path *self, Py_ssize_t index)
{
    const History *history = (History *)PyTuple_GET_ITEM(self->histories, index);
    return (Window){history->block, history->first, history->end, history->first};
}

/* The rows around an instant; `after` is the first sample not before it. False if the window does
 * not cover the instant. */
static inline bool
rows_around(const Window *window, Py_ssize_t after, int64_t at, Bracket *now)
{
    const Block *block = window->block;
    if (after == window->end)
        return false;
    now->b = block->rows + (size_t)after * (size_t)block->width;
    now->a = now->b;
    now->ratio = 0.0;
    int64_t later = block->stamps[after];
    if (later == at)
        return true;
    if (after == window->first)
        return false;
    int64_t earlier = block->stamps[after - 1];
    now->a -= block->width;
    now->ratio =
        (double)((uint64_t)at - (uint64_t)earlier) / (double)((uint64_t)later - (uint64_t)earlier);
    return true;
}

static Pose
pose_at(const Path *self, const Bracket *nows)
{
    Pose source_from_top = chain_pose(self->steps + self->to_target, self->to_source, nows);
    if (self->to_target == 0)
        return source_from_top;
    Pose target_from_top = invert(chain_pose(self->steps, self->to_target, nows));
    return self->to_source == 0 ? target_from_top : compose(target_from_top, source_from_top);
}

/* pose_at of LANES instants. */
static void
poses_at(const Path *self, const Bracket *nows, Py_ssize_t tracks, Poses *poses)
{
    Poses source_from_top;
    if (self->to_target == 0) {
        chain_lanes(self->steps, self->to_source, nows, tracks, poses);
        return;
    }
    chain_lanes(self->steps, self->to_target, nows, tracks, poses);
    for (int i = 0; i < LANES; i++)
        set_lane(poses, i, invert(lane_of(poses, i)));
    if (self->to_source == 0)
        return;
    chain_lanes(self->steps + self->to_target, self->to_source, nows, tracks, &source_from_top);
    compose_lanes(poses, &source_from_top);
}

/* The newest instant that all tracks have reached. False if one is empty. */
static bool
newest_common(const Path *self, int64_t *at)
{
    *at = INT64_MAX;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        const History *history = (History *)PyTuple_GET_ITEM(self->histories, i);
        if (is_empty(history))
            return false;
        int64_t newest = newest_of(history);
        *at = newest < *at ? newest : *at;
    }
    return true;
}

static PyObject *
static_transform(const Path *self, PyObject *stamp)
{
    Pose pose = pose_at(self, NULL);
    if (!is_finite(pose))
        Py_RETURN_NONE;
    return fields_new(self->type, self->target, self->source, pose, stamp, kind_static);
}

/* The transform at an instant, or None; `stamp` is NULL or the object that the caller passed. */
static inline PyObject *
transform_at(const Path *self, int64_t at, PyObject *stamp, Bracket *nows)
{
    PyObject *kind = kind_exact;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        Window window = window_of(self, i);
        Py_ssize_t after = index_not_before(window.block, window.first, window.end, at);
        if (!rows_around(&window, after, at, &nows[i]))
            Py_RETURN_NONE;
        if (nows[i].a != nows[i].b)
            kind = kind_interpolated;
    }
    Pose pose = normalized(pose_at(self, nows));
    if (!is_finite(pose))
        Py_RETURN_NONE;
    if (stamp != NULL)
        return fields_new(self->type, self->target, self->source, pose, stamp, kind);
    stamp = PyLong_FromLongLong(at);
    if (stamp == NULL)
        return NULL;
    PyObject *transform = fields_new(self->type, self->target, self->source, pose, stamp, kind);
    Py_DECREF(stamp);
    return transform;
}

/* The same, with memory for the brackets of all tracks, of which there is at least one. */
static inline PyObject *
transform_when(const Path *self, int64_t at, PyObject *stamp)
{
    Py_ssize_t tracks = track_count(self);
    Bracket few[FEW_TRACKS];
    if (tracks <= FEW_TRACKS)
        return transform_at(self, at, stamp, few);
    Bracket *nows = PyMem_New(Bracket, (size_t)tracks);
    if (nows == NULL)
        return PyErr_NoMemory();
    PyObject *transform = transform_at(self, at, stamp, nows);
    PyMem_Free(nows);
    return transform;
}

static PyObject *
path_at(Path *self, PyObject *const *args, Py_ssize_t count)
{
    PyObject *stamp = count == 1 ? args[0] : Py_None;
    int64_t at = 0;
    if (count > 1) {
        PyErr_SetString(PyExc_TypeError, "at(stamp=None)");
        return NULL;
    }
    if (stamp != Py_None && !plain_stamp(stamp, &at))
        Py_RETURN_NONE;
    if (track_count(self) == 0)
        return static_transform(self, stamp);
    if (stamp == Py_None) {
        stamp = NULL;
        if (!newest_common(self, &at))
            Py_RETURN_NONE;
    }
    return transform_when(self, at, stamp);
}

/* at_both(stamp, other, other_stamp): at one moment, because neither evaluation runs other code:
 * transforms are no objects that make the garbage collector run. */
static PyObject *
path_at_both(Path *self, PyObject *const *args, Py_ssize_t count)
{
    if (count != 3 || !PyObject_TypeCheck(args[1], &Path_type)) {
        PyErr_SetString(PyExc_TypeError, "at_both(stamp, other, other_stamp)");
        return NULL;
    }
    PyObject *first = path_at(self, &args[0], 1);
    PyObject *second = first == NULL ? NULL : path_at((Path *)args[1], &args[2], 1);
    PyObject *both = NULL;
    if (first == Py_None || second == Py_None) {
        both = Py_None;
        Py_INCREF(both);
    }
    else if (second != NULL)
        both = PyTuple_Pack(2, first, second);
    Py_XDECREF(first);
    Py_XDECREF(second);
    return both;
}

/* failure_at(stamp): the limiting track, in the order of zstate/buffer/path.py. */

typedef enum { IN_PAST, NO_DATA, IN_FUTURE } Failure;

static PyObject *
failure_of(const Path *self, Failure failure, Py_ssize_t index, PyObject *stamp)
{
    const History *history = (History *)PyTuple_GET_ITEM(self->histories, index);
    if (is_empty(history))
        return Py_BuildValue("(inOOOO)", (int)failure, index, stamp, Py_None, Py_None, Py_None);
    long long oldest = history->block->stamps[history->first], newest = newest_of(history);
    if (oldest == newest)
        return Py_BuildValue("(inOLLO)", (int)failure, index, stamp, oldest, newest, Py_None);
    double periods = (double)(history->end - history->first - 1);
    double rate_hz = periods * 1e9 / (double)((uint64_t)newest - (uint64_t)oldest);
    return Py_BuildValue("(inOLLd)", (int)failure, index, stamp, oldest, newest, rate_hz);
}

static PyObject *
path_failure_at(Path *self, PyObject *stamp)
{
    int64_t at = 0, worst_oldest = 0, worst_newest = 0;
    Py_ssize_t young = -1, empty = -1, behind = -1;
    bool latest = stamp == Py_None;
    if (!latest && !plain_stamp(stamp, &at))
        Py_RETURN_NONE;
    for (Py_ssize_t i = 0; i < track_count(self); i++) {
        const History *history = (History *)PyTuple_GET_ITEM(self->histories, i);
        if (is_empty(history)) {
            empty = empty < 0 ? i : empty;
            continue;
        }
        int64_t oldest = history->block->stamps[history->first], newest = newest_of(history);
        if (at < oldest && (young < 0 || oldest >= worst_oldest)) {
            young = i;
            worst_oldest = oldest;
        }
        if (at > newest && (behind < 0 || newest < worst_newest)) {
            behind = i;
            worst_newest = newest;
        }
    }
    if (young >= 0 && !latest)
        return failure_of(self, IN_PAST, young, stamp);
    if (empty >= 0)
        return failure_of(self, NO_DATA, empty, stamp);
    if (behind >= 0 && !latest)
        return failure_of(self, IN_FUTURE, behind, stamp);
    Py_RETURN_NONE;
}

/* Windows of all tracks at one moment, with references to their blocks: the rows in them stay,
 * whatever writers do meanwhile. */

typedef struct {
    Window *windows;
    Bracket *nows; /* of all tracks, for LANES instants */
    Py_ssize_t tracks;
    int64_t oldest; /* every track covers the instants between these two */
    int64_t newest;
} Batch;

static void
batch_release(Batch *batch)
{
    for (Py_ssize_t i = 0; batch->windows != NULL && i < batch->tracks; i++)
        Py_DECREF((PyObject *)batch->windows[i].block);
    PyMem_Free(batch->windows);
    PyMem_Free(batch->nows);
}

static int
batch_begin(const Path *self, Batch *batch)
{
    Py_ssize_t tracks = track_count(self);
    batch->tracks = tracks;
    batch->oldest = INT64_MIN;
    batch->newest = INT64_MAX;
    batch->windows = PyMem_New(Window, (size_t)tracks + 1);
    batch->nows = PyMem_New(Bracket, LANES * ((size_t)tracks + 1));
    if (batch->windows == NULL || batch->nows == NULL) {
        PyMem_Free(batch->windows);
        PyMem_Free(batch->nows);
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < tracks; i++) {
        Window window = window_of(self, i);
        batch->windows[i] = window;
        Py_INCREF((PyObject *)window.block);
        if (window.first == window.end) {
            batch->newest = INT64_MIN;
            batch->oldest = INT64_MAX;
            continue;
        }
        int64_t oldest = window.block->stamps[window.first],
                newest = window.block->stamps[window.end - 1];
        batch->oldest = oldest > batch->oldest ? oldest : batch->oldest;
        batch->newest = newest < batch->newest ? newest : batch->newest;
    }
    return 0;
}

/* A tuple of (block, first, end). */
static PyObject *
windows_of(const Batch *batch)
{
    PyObject *windows = PyTuple_New(batch->tracks);
    for (Py_ssize_t i = 0; windows != NULL && i < batch->tracks; i++) {
        const Window *window = &batch->windows[i];
        PyObject *item = Py_BuildValue("(Onn)", window->block, window->first, window->end);
        if (item == NULL)
            Py_CLEAR(windows);
        else
            PyTuple_SET_ITEM(windows, i, item);
    }
    return windows;
}

/* As index_not_before, for an instant that the window covers. Stamps in order advance from sample
 * to sample; others search only the side of the last instant that they are on. */
static inline Py_ssize_t
index_from_near(const Window *window, int64_t at)
{
    const int64_t *stamps = window->block->stamps;
    Py_ssize_t near = window->near;
    if (stamps[near] < at) {
        near++;
        return stamps[near] >= at ? near : index_not_before(window->block, near, window->end, at);
    }
    if (near == window->first || stamps[near - 1] < at)
        return near;
    return index_not_before(window->block, window->first, near, at);
}

/* The rows around an instant in all tracks. False if one of them does not cover it. */
static inline bool
batch_rows_around(const Batch *batch, int64_t at, Bracket *nows)
{
    if (at < batch->oldest || at > batch->newest)
        return false;
    for (Py_ssize_t i = 0; i < batch->tracks; i++) {
        Window *window = &batch->windows[i];
        window->near = index_from_near(window, at);
        if (!rows_around(window, window->near, at, &nows[i]))
            return false;
    }
    return true;
}

/* False if a number of the pose is not finite. */
static inline bool
batch_finish(const Batch *batch, Pose found, Pose *pose)
{
    if (batch->tracks != 0)
        found = normalized(found);
    if (!is_finite(found))
        return false;
    *pose = found;
    return true;
}

static bool
batch_pose(const Path *self, const Batch *batch, int64_t at, Pose *pose)
{
    return batch_rows_around(batch, at, batch->nows) &&
           batch_finish(batch, pose_at(self, batch->nows), pose);
}

/* at_with_windows(stamp): a transform, and the windows that it is computed from. */

static PyObject *
path_at_with_windows(Path *self, PyObject *stamp)
{
    int64_t at = 0;
    Batch batch;
    Pose pose;
    if (track_count(self) == 0 || (stamp != Py_None && !plain_stamp(stamp, &at)))
        Py_RETURN_NONE;
    if (batch_begin(self, &batch) < 0)
        return NULL;
    at = stamp == Py_None ? batch.newest : at;
    PyObject *found = NULL;
    if (batch_pose(self, &batch, at, &pose)) {
        PyObject *kind = kind_exact;
        for (Py_ssize_t i = 0; i < batch.tracks; i++)
            if (batch.nows[i].a != batch.nows[i].b)
                kind = kind_interpolated;
        PyObject *number = PyLong_FromLongLong(at), *windows = windows_of(&batch);
        if (number != NULL && windows != NULL) {
            PyObject *transform =
                fields_new(self->type, self->target, self->source, pose, number, kind);
            found = transform == NULL ? NULL : PyTuple_Pack(2, transform, windows);
            Py_XDECREF(transform);
        }
        Py_XDECREF(number);
        Py_XDECREF(windows);
    }
    else {
        found = Py_None;
        Py_INCREF(found);
    }
    batch_release(&batch);
    return found;
}

/* poses(stamps, out, valid): a batch, without the GIL. */

static void
batch_run(const Path *self, const Batch *batch, const int64_t *stamps, Py_ssize_t count,
          Pose *poses, char *valid)
{
    const Pose unknown = {Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN, Py_NAN};
    Py_ssize_t tracks = batch->tracks, rows[LANES];
    int lanes = 0;
    Poses found;
    for (Py_ssize_t i = 0; i < count; i++) {
        poses[i] = unknown;
        valid[i] = false;
        if (!batch_rows_around(batch, stamps[i], batch->nows + lanes * tracks))
            continue;
        rows[lanes++] = i;
        if (lanes < LANES)
            continue;
        poses_at(self, batch->nows, tracks, &found);
        for (int k = 0; k < LANES; k++)
            valid[rows[k]] = batch_finish(batch, lane_of(&found, k), &poses[rows[k]]);
        lanes = 0;
    }
    for (int k = 0; k < lanes; k++)
        valid[rows[k]] =
            batch_finish(batch, pose_at(self, batch->nows + k * tracks), &poses[rows[k]]);
}

static PyObject *
poses_into(const Path *self, const Py_buffer *stamps, const Py_buffer *out, const Py_buffer *valid)
{
    Py_ssize_t count = count_of(stamps);
    Batch batch;
    if (count_of(out) % 7 != 0 || count_of(out) / 7 != count || valid->len != count) {
        PyErr_SetString(PyExc_ValueError,
                        "each stamp has seven numbers in out and a byte in valid");
        return NULL;
    }
    if (batch_begin(self, &batch) < 0)
        return NULL;
    Py_BEGIN_ALLOW_THREADS batch_run(self, &batch, stamps->buf, count, out->buf, valid->buf);
    Py_END_ALLOW_THREADS PyObject *windows = windows_of(&batch);
    batch_release(&batch);
    return windows;
}

static PyObject *
path_poses(Path *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer stamps, out, valid;
    PyObject *done = NULL;
    if (count != 3) {
        PyErr_SetString(PyExc_TypeError, "poses(stamps, out, valid)");
        return NULL;
    }
    if (get_stamps(args[0], &stamps) < 0)
        return NULL;
    if (get_doubles(args[1], &out, PyBUF_WRITABLE) == 0) {
        if (PyObject_GetBuffer(args[2], &valid, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE) == 0) {
            done = poses_into(self, &stamps, &out, &valid);
            PyBuffer_Release(&valid);
        }
        PyBuffer_Release(&out);
    }
    PyBuffer_Release(&stamps);
    return done;
}

/* In place.h. */
static PyObject *path_place(Path *self, PyObject *const *args, Py_ssize_t count);

static int
path_read_steps(Path *self, PyObject *to_target, PyObject *to_source, const Py_ssize_t *widths)
{
    self->to_target = PyTuple_GET_SIZE(to_target);
    self->to_source = PyTuple_GET_SIZE(to_source);
    Py_ssize_t count = self->to_target + self->to_source;
    self->steps = PyMem_New(Step, (size_t)count + 1);
    if (self->steps == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *description = i < self->to_target
                                    ? PyTuple_GET_ITEM(to_target, i)
                                    : PyTuple_GET_ITEM(to_source, i - self->to_target);
        if (read_step(description, &self->steps[i]) < 0 ||
            check_step(&self->steps[i], track_count(self), widths) < 0)
            return -1;
    }
    return 0;
}

static int
path_fill(Path *self, PyObject *to_target, PyObject *to_source)
{
    Py_ssize_t tracks = track_count(self);
    Py_ssize_t *widths = PyMem_New(Py_ssize_t, (size_t)tracks + 1);
    if (widths == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < tracks; i++) {
        PyObject *history = PyTuple_GET_ITEM(self->histories, i);
        if (!PyObject_TypeCheck(history, &History_type)) {
            PyErr_SetString(PyExc_TypeError, "the tracks of a path are histories");
            PyMem_Free(widths);
            return -1;
        }
        widths[i] = ((History *)history)->width;
    }
    int done = path_read_steps(self, to_target, to_source, widths);
    PyMem_Free(widths);
    return done;
}

static PyObject *
path_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"type",      "target",    "source", "to_target",
                            "to_source", "histories", NULL};
    PyTypeObject *result_type;
    PyObject *target, *source, *to_target, *to_source, *histories;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!OOO!O!O!:Path", names, &PyType_Type,
                                     &result_type, &target, &source, &PyTuple_Type, &to_target,
                                     &PyTuple_Type, &to_source, &PyTuple_Type, &histories))
        return NULL;
    if (!PyType_IsSubtype(result_type, &TransformFields_type)) {
        PyErr_SetString(PyExc_TypeError, "results are of a type that derives from TransformFields");
        return NULL;
    }
    Path *self = (Path *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    Py_INCREF(result_type);
    Py_INCREF(target);
    Py_INCREF(source);
    Py_INCREF(histories);
    self->type = result_type;
    self->target = target;
    self->source = source;
    self->histories = histories;
    if (path_fill(self, to_target, to_source) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void
path_dealloc(Path *self)
{
    Py_XDECREF((PyObject *)self->type);
    Py_XDECREF(self->target);
    Py_XDECREF(self->source);
    Py_XDECREF(self->histories);
    PyMem_Free(self->steps);
    Py_TYPE(self)->tp_free(self);
}

static PyMethodDef path_methods[] = {
    {"at", (PyCFunction)(void (*)(void))path_at, METH_FASTCALL,
     "at(stamp=None): the Transform, or None if the reference has to be used."},
    {"at_with_windows", (PyCFunction)path_at_with_windows, METH_O,
     "at_with_windows(stamp): as at, with the (block, first, end) of each track that it is of."},
    {"at_both", (PyCFunction)(void (*)(void))path_at_both, METH_FASTCALL,
     "at_both(stamp, other, other_stamp): at of two paths at one moment; None unless both are "
     "found."},
    {"failure_at", (PyCFunction)path_failure_at, METH_O,
     "failure_at(stamp): (failure, track, stamp, oldest, newest, rate_hz), or None when there is "
     "none."},
    {"poses", (PyCFunction)(void (*)(void))path_poses, METH_FASTCALL,
     "poses(stamps, out, valid): many at once; NaN and False where there is no transform. "
     "Returns the (block, first, end) of each track that they are of."},
    {"place", (PyCFunction)(void (*)(void))path_place, METH_FASTCALL,
     "place(points, stamps, out, valid): points moved by the poses at their stamps; NaN and False "
     "where there is none. Returns as poses."},
    {NULL},
};

static PyTypeObject Path_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.Path",
    .tp_doc = "A compiled path between two frames.",
    .tp_basicsize = sizeof(Path),
    .tp_new = path_new,
    .tp_dealloc = (destructor)path_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = path_methods,
};

/* PublishPath: the usual sample of a StatePublisher (zstate/nodes/publisher.py) from its positions
 * to Zenoh in one call.
 *
 * After a pause of some milliseconds all code and memory is cold, and each Python function, object
 * and cache line costs ten times its usual time. So conditions are not checked for each sample:
 * `ready` is set by resume, and cleared by pause from any thread when one of them ends.
 *
 * Threads. One call at a time publishes (`busy`); another one returns False. So samples are sent in
 * the order of their sequence numbers. stop waits for the end of that call. */

typedef struct {
    PyObject_HEAD
    JointStateEncoder *encoder;
    RosJointStateEncoder *ros; /* or NULL on the native wire */
    SampleRing *ring;          /* or NULL */
    PyObject *put;
    PyObject *on_outside;
    double *lower;            /* limits of the positions; the upper ones are behind them */
    PyThread_type_lock ended; /* held, except from the end of a call that `stop` waits for */
    uint64_t seq;
    uint64_t samples;
    uint64_t bytes;
    bool reads_clock;
    bool ready;
    bool busy;
    unsigned long thread; /* that is, or was last, in publish */
    bool is_awaited;
} PublishPath;

static PyTypeObject PublishPath_type;
static PyObject *attachment_names;

static int
publish_path_traverse(PublishPath *self, visitproc visit, void *arg)
{
    Py_VISIT(self->put);
    Py_VISIT(self->on_outside);
    return 0;
}

static int
publish_path_clear(PublishPath *self)
{
    self->ready = false;
    Py_CLEAR(self->put);
    Py_CLEAR(self->on_outside);
    return 0;
}

static void
publish_path_dealloc(PublishPath *self)
{
    PyObject_GC_UnTrack(self);
    publish_path_clear(self);
    Py_CLEAR(self->encoder);
    Py_CLEAR(self->ros);
    Py_CLEAR(self->ring);
    PyMem_Free(self->lower);
    if (self->ended != NULL)
        PyThread_free_lock(self->ended);
    Py_TYPE(self)->tp_free(self);
}

static int
publish_path_fill(PublishPath *self, PyObject *lower, PyObject *upper)
{
    PyObject *limits[] = {lower, upper};
    Py_ssize_t count = self->encoder->positions;
    self->lower = PyMem_New(double, 2 * (size_t)count + 1);
    self->ended = PyThread_allocate_lock();
    if (self->lower == NULL || self->ended == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    PyThread_acquire_lock(self->ended, WAIT_LOCK);
    for (int i = 0; i < 2; i++) {
        Py_buffer view;
        if (get_doubles(limits[i], &view, 0) < 0)
            return -1;
        bool fits = count_of(&view) == count;
        if (fits && count != 0)
            memcpy(self->lower + i * count, view.buf, (size_t)count * 8);
        PyBuffer_Release(&view);
        if (!fits) {
            PyErr_Format(PyExc_ValueError, "%zd positions need as many limits", count);
            return -1;
        }
    }
    return 0;
}

static bool
have_same_counts(const JointStateEncoder *one, const RosJointStateEncoder *other)
{
    return one->positions == other->positions && one->velocities == other->velocities;
}

static PyObject *
publish_path_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"encoder", "ros",        "ring",        "put", "lower",
                            "upper",   "on_outside", "reads_clock", NULL};
    PyObject *encoder, *ros, *ring, *put, *lower, *upper, *on_outside;
    int reads_clock;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!OOOOOOp:PublishPath", names,
                                     &JointStateEncoder_type, &encoder, &ros, &ring, &put, &lower,
                                     &upper, &on_outside, &reads_clock))
        return NULL;
    if ((ring != Py_None && !Py_IS_TYPE(ring, &SampleRing_type)) ||
        (ros != Py_None && !Py_IS_TYPE(ros, &RosJointStateEncoder_type))) {
        PyErr_SetString(PyExc_TypeError,
                        "ros is a RosJointStateEncoder, ring a SampleRing, or None");
        return NULL;
    }
    if (ros != Py_None &&
        !have_same_counts((JointStateEncoder *)encoder, (RosJointStateEncoder *)ros)) {
        PyErr_SetString(PyExc_ValueError, "the encoders of one robot have as many numbers");
        return NULL;
    }
    PublishPath *self = (PublishPath *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    self->encoder = (JointStateEncoder *)Py_NewRef(encoder);
    self->ros = ros == Py_None ? NULL : (RosJointStateEncoder *)Py_NewRef(ros);
    self->ring = ring == Py_None ? NULL : (SampleRing *)Py_NewRef(ring);
    self->put = Py_NewRef(put);
    self->on_outside = Py_NewRef(on_outside);
    self->reads_clock = reads_clock != 0;
    if (publish_path_fill(self, lower, upper) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static bool
present_time(int64_t *stamp)
{
    struct timespec now;
#ifdef _WIN32
    if (timespec_get(&now, TIME_UTC) != TIME_UTC)
        return false;
#else
    if (clock_gettime(CLOCK_REALTIME, &now) != 0)
        return false;
#endif
    *stamp = (int64_t)now.tv_sec * SECOND_NS + now.tv_nsec;
    return true;
}

/* The stamp of a sample, or the present time for None. False if the publisher determines it. */
static bool
sample_stamp(const PublishPath *self, PyObject *given, int64_t *stamp)
{
    if (given != Py_None)
        return plain_stamp(given, stamp);
    return self->reads_clock && present_time(stamp);
}

static bool
are_outside(const PublishPath *self, const double *positions)
{
    Py_ssize_t count = self->encoder->positions;
    const double *lower = self->lower, *upper = self->lower + count;
    bool outside = false;
    for (Py_ssize_t i = 0; i < count; i++)
        outside |= (positions[i] < lower[i]) | (positions[i] > upper[i]);
    return outside;
}

/* Calls Zenoh's put; with an attachment, if the wire has them. */
static PyObject *
call_put(PublishPath *self, PyObject *payload)
{
    int64_t now;
    if (self->ros == NULL || !self->ros->has_gid)
        return PyObject_Vectorcall(self->put, &payload, 1, NULL);
    if (!present_time(&now)) {
        PyErr_SetString(PyExc_OSError, "the clock cannot be read");
        return NULL;
    }
    PyObject *attachment = ros_attachment(self->ros, now);
    if (attachment == NULL)
        return NULL;
    PyObject *arguments[] = {payload, attachment};
    PyObject *sent = PyObject_Vectorcall(self->put, arguments, 1, attachment_names);
    Py_DECREF(attachment);
    if (sent == NULL)
        self->ros->attached--;
    return sent;
}

/* Caches and sends a payload. 1 if it was sent; 0, without an error, if Zenoh refused it: then it
 * is not cached either. -1 and an error if neither is the case. */
static int
send_payload(PublishPath *self, int64_t stamp, PyObject *payload)
{
    /* Before sending: a reader that misses this sample can then request it as history. */
    if (self->ring != NULL && ring_add(self->ring, stamp, (int64_t)self->seq, payload) < 0)
        return -1;
    PyObject *sent = call_put(self, payload);
    if (sent != NULL) {
        Py_DECREF(sent);
        self->seq++;
        self->samples++;
        self->bytes += (uint64_t)PyBytes_GET_SIZE(payload);
        return 1;
    }
    if (self->ring != NULL)
        ring_drop_newest(self->ring);
    if (!PyErr_ExceptionMatches(PyExc_Exception))
        return -1;
    PyErr_Clear();
    return 0;
}

/* As send_payload; 0 also for a sample that is not a usual one. `outside` receives the payload of a
 * sample with positions outside limits, on the native wire or as for it. */
static int
publish_sample(PublishPath *self, PyObject *const *args, PyObject **outside)
{
    Numbers numbers;
    int64_t stamp;
    if (!sample_stamp(self, args[3], &stamp) || !get_numbers(self->encoder, args, &numbers))
        return 0;
    PyObject *native = NULL, *ros = NULL;
    bool is_outside = are_outside(self, numbers.positions.values);
    if (self->ros == NULL || is_outside)
        native = encoder_payload(self->encoder, &numbers, stamp, self->seq);
    if (self->ros != NULL)
        ros = ros_payload(self->ros, &numbers, stamp);
    release_numbers(&numbers);
    int result = PyErr_Occurred() ? -1 : 0;
    PyObject *payload = self->ros == NULL ? native : ros;
    if (result == 0 && payload != NULL)
        result = send_payload(self, stamp, payload);
    if (result == 1 && is_outside)
        *outside = Py_NewRef(native);
    Py_XDECREF(native);
    Py_XDECREF(ros);
    return result;
}

static PyObject *
publish_path_publish(PublishPath *self, PyObject *const *args, Py_ssize_t count)
{
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "publish(positions, velocities, efforts, stamp)");
        return NULL;
    }
    if (!self->ready || self->busy)
        Py_RETURN_FALSE;
    PyObject *outside = NULL;
    self->busy = true;
    self->thread = PyThread_get_thread_ident();
    int result = publish_sample(self, args, &outside);
    self->busy = false;
    if (self->is_awaited) {
        self->is_awaited = false;
        PyThread_release_lock(self->ended);
    }
    if (outside != NULL) { /* no longer busy: its log handlers may publish or close */
        PyObject *counted = PyObject_CallOneArg(self->on_outside, outside);
        Py_DECREF(outside);
        if (counted == NULL)
            return NULL;
        Py_DECREF(counted);
    }
    return result < 0 ? NULL : PyBool_FromLong(result);
}

static PyObject *
publish_path_resume(PublishPath *self, PyObject *seq)
{
    int64_t number;
    if (!checked_stamp(seq, &number))
        return NULL;
    if (number < 0 || self->busy) {
        PyErr_SetString(PyExc_ValueError, "a sequence number is not negative; stop() first");
        return NULL;
    }
    self->seq = (uint64_t)number;
    self->ready = self->put != NULL;
    Py_RETURN_NONE;
}

static PyObject *
publish_path_pause(PublishPath *self, PyObject *Py_UNUSED(none))
{
    self->ready = false;
    Py_RETURN_NONE;
}

static PyObject *
publish_path_stop(PublishPath *self, PyObject *Py_UNUSED(none))
{
    self->ready = false;
    if (self->busy && self->thread == PyThread_get_thread_ident()) {
        PyErr_SetString(PyExc_RuntimeError, "publish() called what waits for its own end");
        return NULL;
    }
    while (self->busy) {
        self->is_awaited = true;
        Py_BEGIN_ALLOW_THREADS PyThread_acquire_lock(self->ended, WAIT_LOCK);
        Py_END_ALLOW_THREADS
    }
    return PyLong_FromUnsignedLongLong(self->seq);
}

static PyMethodDef publish_path_methods[] = {
    {"publish", (PyCFunction)(void (*)(void))publish_path_publish, METH_FASTCALL,
     "publish(positions, velocities, efforts, stamp): whether the sample was published; if not, "
     "nothing "
     "was changed."},
    {"resume", (PyCFunction)publish_path_resume, METH_O,
     "resume(seq): publish from now on; the next sample has the number seq."},
    {"pause", (PyCFunction)publish_path_pause, METH_NOARGS,
     "pause(): publish nothing until resume. Does not wait, and may be called from any thread."},
    {"stop", (PyCFunction)publish_path_stop, METH_NOARGS,
     "stop(): pause, and wait for the sample that another thread is publishing. The number of the "
     "next "
     "sample. One thread at a time."},
    {NULL},
};

static PyMemberDef publish_path_members[] = {
    {"ready", T_BOOL, offsetof(PublishPath, ready), READONLY, "Whether publish may succeed."},
    {"seq", T_ULONGLONG, offsetof(PublishPath, seq), READONLY, "The number of the next sample."},
    {"samples", T_ULONGLONG, offsetof(PublishPath, samples), READONLY, "How many were published."},
    {"bytes", T_ULONGLONG, offsetof(PublishPath, bytes), READONLY, "The bytes of their payloads."},
    {NULL},
};

static PyTypeObject PublishPath_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.PublishPath",
    .tp_doc = "Publishes the usual samples of one writer.",
    .tp_basicsize = sizeof(PublishPath),
    .tp_new = publish_path_new,
    .tp_dealloc = (destructor)publish_path_dealloc,
    .tp_traverse = (traverseproc)publish_path_traverse,
    .tp_clear = (inquiry)publish_path_clear,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_methods = publish_path_methods,
    .tp_members = publish_path_members,
};

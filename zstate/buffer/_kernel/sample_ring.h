/* SampleRing: the cached samples of a writer, for SampleCache in zstate/net/sample_history.py. */

#define FEWEST_CACHED 64

typedef struct {
    int64_t stamp;
    int64_t seq;
    PyObject *payload; /* bytes */
} CachedSample;

typedef struct {
    PyObject_HEAD
    Py_ssize_t capacity; /* of the ring; there is memory for `allocated` of them, a power of two */
    Py_ssize_t allocated;
    Py_ssize_t first;
    Py_ssize_t count;
    int64_t span_ns;
    int64_t set_back_ns;
    int64_t newest;
    CachedSample *samples;
} SampleRing;

static PyTypeObject SampleRing_type;

static PyObject *
ring_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"capacity", "span_ns", "set_back_ns", NULL};
    Py_ssize_t capacity;
    long long span_ns, set_back_ns;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "nLL:SampleRing", names, &capacity, &span_ns,
                                     &set_back_ns))
        return NULL;
    if (capacity < 1 || span_ns < 0 || set_back_ns < 0) {
        PyErr_SetString(PyExc_ValueError,
                        "a ring has room for a sample, and spans are not negative");
        return NULL;
    }
    SampleRing *self = (SampleRing *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    self->capacity = capacity;
    self->span_ns = span_ns;
    self->set_back_ns = set_back_ns;
    return (PyObject *)self;
}

static CachedSample *
ring_at(const SampleRing *self, Py_ssize_t index)
{
    return &self->samples[(self->first + index) & (self->allocated - 1)];
}

static void
ring_drop_oldest(SampleRing *self)
{
    PyObject *payload = ring_at(self, 0)->payload;
    self->first = (self->first + 1) & (self->allocated - 1);
    self->count--;
    Py_DECREF(payload); /* bytes: runs no code */
}

static void
ring_clear(SampleRing *self)
{
    while (self->count > 0)
        ring_drop_oldest(self);
}

static int
ring_grow(SampleRing *self)
{
    Py_ssize_t allocated = self->allocated == 0 ? FEWEST_CACHED : 2 * self->allocated;
    CachedSample *samples = PyMem_New(CachedSample, (size_t)allocated);
    if (samples == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < self->count; i++)
        samples[i] = *ring_at(self, i);
    PyMem_Free(self->samples);
    self->samples = samples;
    self->allocated = allocated;
    self->first = 0;
    return 0;
}

/* a - b, or the nearest number of 64 bits. */
static int64_t
saturated_difference(int64_t a, int64_t b)
{
    if (b > 0 && a < INT64_MIN + b)
        return INT64_MIN;
    if (b < 0 && a > INT64_MAX + b)
        return INT64_MAX;
    return a - b;
}

/* Appends a sample and drops what is older than the span before it. */
static int
ring_add(SampleRing *self, int64_t stamp, int64_t seq, PyObject *payload)
{
    if (self->count == self->allocated && self->count < self->capacity && ring_grow(self) < 0)
        return -1;
    if (stamp < self->newest && stamp < saturated_difference(self->newest, self->set_back_ns))
        ring_clear(self); /* the clock was set back: readers start a new history, too */
    if (self->count == 0 || stamp > self->newest)
        self->newest = stamp;
    if (self->count == self->capacity)
        ring_drop_oldest(self);
    self->count++;
    *ring_at(self, self->count - 1) = (CachedSample){stamp, seq, Py_NewRef(payload)};
    int64_t limit = saturated_difference(stamp, self->span_ns);
    while (ring_at(self, 0)->stamp < limit)
        ring_drop_oldest(self);
    return 0;
}

static void
ring_drop_newest(SampleRing *self)
{
    if (self->count > 0)
        Py_DECREF(ring_at(self, --self->count)->payload);
}

static PyObject *
ring_append(SampleRing *self, PyObject *const *args, Py_ssize_t count)
{
    int64_t stamp, seq;
    if (count != 3 || !PyBytes_CheckExact(args[2])) {
        PyErr_SetString(PyExc_TypeError, "append(stamp, seq, payload)");
        return NULL;
    }
    if (!checked_stamp(args[0], &stamp) || !checked_stamp(args[1], &seq) ||
        ring_add(self, stamp, seq, args[2]) < 0)
        return NULL;
    Py_RETURN_NONE;
}

static PyObject *
ring_samples(SampleRing *self, PyObject *Py_UNUSED(none))
{
    /* Copied first: creating objects may run the garbage collector, and with it any code. */
    Py_ssize_t count = self->count;
    CachedSample *copied = PyMem_New(CachedSample, (size_t)count + 1);
    if (copied == NULL)
        return PyErr_NoMemory();
    for (Py_ssize_t i = 0; i < count; i++) {
        copied[i] = *ring_at(self, i);
        Py_INCREF(copied[i].payload);
    }
    PyObject *list = PyList_New(count);
    for (Py_ssize_t i = 0; i < count; i++) {
        const CachedSample *one = &copied[i];
        PyObject *sample = list == NULL ? NULL
                                        : Py_BuildValue("LLO", (long long)one->stamp,
                                                        (long long)one->seq, one->payload);
        Py_DECREF(one->payload);
        if (sample != NULL)
            PyList_SET_ITEM(list, i, sample);
        else
            Py_CLEAR(list);
    }
    PyMem_Free(copied);
    return list;
}

static void
ring_dealloc(SampleRing *self)
{
    ring_clear(self);
    PyMem_Free(self->samples);
    Py_TYPE(self)->tp_free(self);
}

static PyMethodDef ring_methods[] = {
    {"append", (PyCFunction)(void (*)(void))ring_append, METH_FASTCALL,
     "append(stamp, seq, payload): a sample, whose seq is one more than that of the last."},
    {"samples", (PyCFunction)ring_samples, METH_NOARGS,
     "samples(): the cached (stamp, seq, payload), the oldest first."},
    {NULL},
};

static PyTypeObject SampleRing_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.SampleRing",
    .tp_doc = "The samples of the last seconds of a writer.",
    .tp_basicsize = sizeof(SampleRing),
    .tp_new = ring_new,
    .tp_dealloc = (destructor)ring_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = ring_methods,
};

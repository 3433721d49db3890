/* RosJointStateEncoder: a JointState of ROS 2 as CDR, and its attachment, for RosStreamEncoder in
 * zstate/wire/ros2/encoder.py. Only the stamp and the numbers differ between two payloads. */

#define SECOND_NS 1000000000
#define ATTACHMENT_SIZE 33
#define GID_SIZE 16

typedef struct {
    PyObject_HEAD
    Py_ssize_t positions;
    Py_ssize_t velocities;
    Py_ssize_t *slots; /* the coordinate of each velocity */
    PyObject *parts;   /* for each of without and with velocities, then efforts: four bytes objects,
                        * which are before the stamp, the positions, the velocities and the efforts */
    uint64_t attached;
    bool has_gid;
    char gid[GID_SIZE];
} RosJointStateEncoder;

static PyTypeObject RosJointStateEncoder_type;

static int
ros_fill(RosJointStateEncoder *self, PyObject *parts, PyObject *slots)
{
    bool fits = PyTuple_GET_SIZE(parts) == 4 && self->velocities <= LARGEST_WIDTH &&
                self->positions >= 0 && self->positions <= LARGEST_WIDTH;
    for (Py_ssize_t i = 0; fits && i < 4; i++) {
        PyObject *four = PyTuple_GET_ITEM(parts, i);
        fits = PyTuple_CheckExact(four) && PyTuple_GET_SIZE(four) == 4;
        for (Py_ssize_t k = 0; fits && k < 4; k++)
            fits = PyBytes_CheckExact(PyTuple_GET_ITEM(four, k)) != 0;
    }
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "a payload has four parts of bytes, in four forms");
        return -1;
    }
    self->parts = Py_NewRef(parts);
    self->slots = PyMem_New(Py_ssize_t, (size_t)self->velocities + 1);
    if (self->slots == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < self->velocities; i++) {
        self->slots[i] = PyLong_AsSsize_t(PyTuple_GET_ITEM(slots, i));
        if (self->slots[i] == -1 && PyErr_Occurred())
            return -1;
        if (self->slots[i] < 0 || self->slots[i] >= self->positions) {
            PyErr_Format(PyExc_ValueError, "there is no coordinate %zd", self->slots[i]);
            return -1;
        }
    }
    return 0;
}

static PyObject *
ros_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"parts", "positions", "slots", "gid", NULL};
    PyObject *parts, *slots;
    const char *gid;
    Py_ssize_t positions, gid_size;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!nO!z#:RosJointStateEncoder", names,
                                     &PyTuple_Type, &parts, &positions, &PyTuple_Type, &slots, &gid,
                                     &gid_size))
        return NULL;
    if (gid != NULL && gid_size != GID_SIZE) {
        PyErr_SetString(PyExc_ValueError, "a gid has 16 bytes");
        return NULL;
    }
    RosJointStateEncoder *self = (RosJointStateEncoder *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    self->positions = positions;
    self->velocities = PyTuple_GET_SIZE(slots);
    self->has_gid = gid != NULL;
    if (gid != NULL)
        memcpy(self->gid, gid, GID_SIZE);
    if (ros_fill(self, parts, slots) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void
ros_dealloc(RosJointStateEncoder *self)
{
    Py_CLEAR(self->parts);
    PyMem_Free(self->slots);
    Py_TYPE(self)->tp_free(self);
}

/* The low bytes of a number, the lowest first. Returns the end. */
static char *
put_little(char *at, uint64_t number, int bytes)
{
    for (int i = 0; i < bytes; i++)
        *at++ = (char)(number >> (8 * i));
    return at;
}

static char *
put_part(char *at, PyObject *part)
{
    size_t size = (size_t)PyBytes_GET_SIZE(part);
    memcpy(at, PyBytes_AS_STRING(part), size);
    return at + size;
}

/* Numbers with one for each velocity, each at the index of its coordinate; NaN at the others.
 * Nothing for a row without values. */
static char *
put_spread(const RosJointStateEncoder *self, char *at, const Row *row)
{
    const double unknown = NAN;
    if (row->values == NULL)
        return at;
    if (self->velocities != self->positions) {
        for (Py_ssize_t i = 0; i < self->positions; i++)
            memcpy(at + 8 * i, &unknown, 8);
        for (Py_ssize_t i = 0; i < self->velocities; i++)
            memcpy(at + 8 * self->slots[i], &row->values[i], 8);
    }
    else if (row->size != 0) {
        memcpy(at, row->values, (size_t)row->size);
    }
    return at + 8 * self->positions;
}

/* NULL, without an error, for a stamp that ROS cannot represent. */
static PyObject *
ros_payload(const RosJointStateEncoder *self, const Numbers *numbers, int64_t stamp)
{
    int64_t seconds = stamp / SECOND_NS - (stamp % SECOND_NS < 0);
    if (stamp == 0 || seconds < INT32_MIN || seconds > INT32_MAX)
        return NULL;
    int form =
        (numbers->velocities.values != NULL ? 2 : 0) + (numbers->efforts.values != NULL ? 1 : 0);
    PyObject *const *parts = &PyTuple_GET_ITEM(PyTuple_GET_ITEM(self->parts, form), 0);
    Py_ssize_t size = 8, blocks = 1 + (form >> 1) + (form & 1);
    for (int i = 0; i < 4; i++)
        size += PyBytes_GET_SIZE(parts[i]);
    PyObject *payload = PyBytes_FromStringAndSize(NULL, size + 8 * self->positions * blocks);
    if (payload == NULL)
        return NULL;
    char *at = put_part(PyBytes_AS_STRING(payload), parts[0]);
    at = put_little(at, (uint64_t)seconds, 4);
    at = put_little(at, (uint64_t)(stamp - seconds * SECOND_NS), 4);
    at = put_part(at, parts[1]);
    if (numbers->positions.size != 0)
        memcpy(at, numbers->positions.values, (size_t)numbers->positions.size);
    at = put_part(at + numbers->positions.size, parts[2]);
    at = put_part(put_spread(self, at, &numbers->velocities), parts[3]);
    put_spread(self, at, &numbers->efforts);
    return payload;
}

/* The attachment of the next payload, sent at `now`. */
static PyObject *
ros_attachment(RosJointStateEncoder *self, int64_t now)
{
    PyObject *attachment = PyBytes_FromStringAndSize(NULL, ATTACHMENT_SIZE);
    if (attachment == NULL)
        return NULL;
    char *at = put_little(PyBytes_AS_STRING(attachment), ++self->attached, 8);
    at = put_little(at, (uint64_t)now, 8);
    *at++ = GID_SIZE;
    memcpy(at, self->gid, GID_SIZE);
    return attachment;
}

static PyObject *
ros_encode(RosJointStateEncoder *self, PyObject *const *args, Py_ssize_t count)
{
    Numbers numbers;
    int64_t stamp;
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "encode(positions, velocities, efforts, stamp)");
        return NULL;
    }
    const JointStateEncoder counts = {.positions = self->positions, .velocities = self->velocities};
    if (!plain_stamp(args[3], &stamp) || !get_numbers(&counts, args, &numbers))
        Py_RETURN_NONE;
    PyObject *payload = ros_payload(self, &numbers, stamp);
    release_numbers(&numbers);
    if (payload == NULL && !PyErr_Occurred())
        Py_RETURN_NONE;
    return payload;
}

static PyObject *
ros_next_attachment(RosJointStateEncoder *self, PyObject *now)
{
    int64_t stamp;
    if (!checked_stamp(now, &stamp))
        return NULL;
    if (!self->has_gid)
        Py_RETURN_NONE;
    return ros_attachment(self, stamp);
}

static PyMethodDef ros_methods[] = {
    {"encode", (PyCFunction)(void (*)(void))ros_encode, METH_FASTCALL,
     "encode(positions, velocities, efforts, stamp): the payload; None for anything but "
     "finite numbers in the right count, in flat arrays of doubles, lists or tuples, and a stamp "
     "of "
     "ROS."},
    {"attachment", (PyCFunction)ros_next_attachment, METH_O,
     "attachment(now): the attachment of the next payload; None without a gid."},
    {NULL},
};

static PyTypeObject RosJointStateEncoder_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.RosJointStateEncoder",
    .tp_doc = "The joint states of one writer as messages of ROS 2.",
    .tp_basicsize = sizeof(RosJointStateEncoder),
    .tp_new = ros_new,
    .tp_dealloc = (destructor)ros_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = ros_methods,
};

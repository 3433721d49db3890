/* JointStateEncoder: from positions to the payload of a JointState in one call, for RobotEncoder in
 * zstate/nodes/publisher.py. The payload is a MessagePack array of eight: stamp, seq, session,
 * order, positions, velocities, efforts, names. */

/* The longest parts of a payload: array and three integers, digest, then a block without its
 * numbers (three of them), nil. */
#define LONGEST_HEAD (1 + 3 * 9 + 10 + 3 * 5 + 1)

/* Quaternions this close to unit length need no decision; the reference makes it for others. */
#define CLEARLY_UNIT 0.5e-3

typedef struct {
    PyObject_HEAD
    Py_ssize_t positions; /* how many numbers there are of each kind */
    Py_ssize_t velocities;
    Py_ssize_t *quaternions; /* the first columns of the quaternions of floating joints */
    Py_ssize_t quaternion_count;
    uint64_t session;
    char order[8];
} JointStateEncoder;

static PyTypeObject JointStateEncoder_type;

static int
encoder_fill(JointStateEncoder *self, PyObject *quaternions)
{
    Py_ssize_t count = PyTuple_GET_SIZE(quaternions);
    self->quaternions = PyMem_New(Py_ssize_t, (size_t)count + 1);
    if (self->quaternions == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        Py_ssize_t column = PyLong_AsSsize_t(PyTuple_GET_ITEM(quaternions, i));
        if (column == -1 && PyErr_Occurred())
            return -1;
        if (column < 0 || column > self->positions - 4) {
            PyErr_Format(PyExc_ValueError, "there is no quaternion at column %zd", column);
            return -1;
        }
        self->quaternions[i] = column;
    }
    self->quaternion_count = count;
    return 0;
}

static PyObject *
encoder_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"session", "order", "positions", "velocities", "quaternions", NULL};
    PyObject *session, *quaternions;
    const char *order;
    Py_ssize_t order_size, positions, velocities;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "O!y#nnO!:JointStateEncoder", names,
                                     &PyLong_Type, &session, &order, &order_size, &positions,
                                     &velocities, &PyTuple_Type, &quaternions))
        return NULL;
    uint64_t number = PyLong_AsUnsignedLongLong(session);
    if (number == (uint64_t)-1 && PyErr_Occurred())
        return NULL;
    if (order_size != 8 || positions < 0 || positions > LARGEST_WIDTH || velocities < 0 ||
        velocities > LARGEST_WIDTH) {
        PyErr_SetString(PyExc_ValueError,
                        "an order has 8 bytes, and a robot up to 2**20 numbers of each kind");
        return NULL;
    }
    JointStateEncoder *self = (JointStateEncoder *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    self->session = number;
    self->positions = positions;
    self->velocities = velocities;
    memcpy(self->order, order, sizeof(self->order));
    if (encoder_fill(self, quaternions) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void
encoder_dealloc(JointStateEncoder *self)
{
    PyMem_Free(self->quaternions);
    Py_TYPE(self)->tp_free(self);
}

/* A type byte and the low bytes of a number, the highest first. Returns the end. */
static char *
put_typed(char *at, int type, uint64_t number, int bytes)
{
    *at++ = (char)type;
    while (bytes-- > 0)
        *at++ = (char)(number >> (8 * bytes));
    return at;
}

/* The shortest form of a number that is not negative. */
static char *
put_unsigned(char *at, uint64_t number)
{
    if (number < 0x80)
        return put_typed(at, (int)number, 0, 0);
    if (number <= UINT8_MAX)
        return put_typed(at, 0xcc, number, 1);
    if (number <= UINT16_MAX)
        return put_typed(at, 0xcd, number, 2);
    if (number <= UINT32_MAX)
        return put_typed(at, 0xce, number, 4);
    return put_typed(at, 0xcf, number, 8);
}

static char *
put_signed(char *at, int64_t number)
{
    if (number >= 0)
        return put_unsigned(at, (uint64_t)number);
    if (number >= -32)
        return put_typed(at, (int)number, 0, 0);
    if (number >= INT8_MIN)
        return put_typed(at, 0xd0, (uint64_t)number, 1);
    if (number >= INT16_MIN)
        return put_typed(at, 0xd1, (uint64_t)number, 2);
    if (number >= INT32_MIN)
        return put_typed(at, 0xd2, (uint64_t)number, 4);
    return put_typed(at, 0xd3, (uint64_t)number, 8);
}

static char *
put_bytes(char *at, const void *bytes, size_t size)
{
    if (size <= UINT8_MAX)
        at = put_typed(at, 0xc4, size, 1);
    else if (size <= UINT16_MAX)
        at = put_typed(at, 0xc5, size, 2);
    else
        at = put_typed(at, 0xc6, size, 4);
    if (size != 0)
        memcpy(at, bytes, size);
    return at + size;
}

/* Some doubles without gaps, in the memory of an array or copied; `values` is NULL for None. */
typedef struct {
    const double *values;
    Py_ssize_t size; /* in bytes */
    Py_buffer view;  /* without an object if they are copied */
    double *copy;
} Row;

static void
release_row(Row *row)
{
    PyBuffer_Release(&row->view);
    PyMem_Free(row->copy);
}

/* A block, or nil for none. */
static char *
put_block(char *at, const Row *row)
{
    return row->values == NULL ? put_typed(at, 0xc0, 0, 0)
                               : put_bytes(at, row->values, (size_t)row->size);
}

/* The number in a float or an int; false, with or without an error, for anything else. */
static bool
plain_number(PyObject *object, double *number)
{
    if (PyFloat_Check(object))
        *number = PyFloat_AS_DOUBLE(object);
    else if (PyLong_CheckExact(object))
        *number = PyLong_AsDouble(object);
    else
        return false;
    return *number != -1.0 || !PyErr_Occurred();
}

static bool
copy_sequence(PyObject *sequence, Row *row, Py_ssize_t count)
{
    if (PySequence_Fast_GET_SIZE(sequence) != count)
        return false;
    PyObject *const *items = PySequence_Fast_ITEMS(sequence);
    row->copy = PyMem_New(double, (size_t)count + 1);
    for (Py_ssize_t i = 0; row->copy != NULL && i < count; i++)
        if (!plain_number(items[i], &row->copy[i]))
            return false;
    row->values = row->copy;
    return row->copy != NULL;
}

/* Only numbers that are not in order, such as a column of a matrix, or not aligned are copied. */
static bool
read_array(PyObject *array, Row *row, Py_ssize_t count)
{
    Py_buffer *view = &row->view;
    if (PyObject_GetBuffer(array, view, PyBUF_STRIDED_RO | PyBUF_FORMAT) < 0)
        return false;
    const char *format = view->format != NULL ? view->format : "B";
    if (view->ndim != 1 || view->shape[0] != count || strcmp(format, "d") != 0)
        return false;
    row->values = view->buf;
    if ((view->strides[0] == 8 && (uintptr_t)view->buf % 8 == 0) || count == 0)
        return true;
    row->values = row->copy = PyMem_New(double, (size_t)count);
    for (Py_ssize_t i = 0; row->copy != NULL && i < count; i++)
        memcpy(&row->copy[i], (const char *)view->buf + i * view->strides[0], 8);
    return row->copy != NULL;
}

/* `count` finite numbers in a flat array of doubles, a list or a tuple. False, without an error,
 * for anything else; release_row in either case. */
static bool
get_row(PyObject *object, Row *row, Py_ssize_t count)
{
    bool is_read = PyList_CheckExact(object) || PyTuple_CheckExact(object)
                       ? copy_sequence(object, row, count)
                       : plain_array(object) && read_array(object, row, count);
    if (!is_read)
        PyErr_Clear();
    row->size = 8 * count;
    return is_read && all_finite(row->values, count);
}

static bool
quaternions_are_unit(const JointStateEncoder *self, const double *positions)
{
    for (Py_ssize_t i = 0; i < self->quaternion_count; i++) {
        const double *q = positions + self->quaternions[i];
        double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        if (!(fabs(length - 1.0) <= CLEARLY_UNIT))
            return false;
    }
    return true;
}

/* The numbers of one sample. */
typedef struct {
    Row positions, velocities, efforts;
} Numbers;

static void
release_numbers(Numbers *numbers)
{
    release_row(&numbers->positions);
    release_row(&numbers->velocities);
    release_row(&numbers->efforts);
}

/* Positions, velocities and efforts, the last two as get_row or None. False, without an error, for
 * anything else, and for numbers of another count. */
static bool
get_numbers(const JointStateEncoder *self, PyObject *const *args, Numbers *numbers)
{
    memset(numbers, 0, sizeof(*numbers));
    if (PY_LITTLE_ENDIAN && get_row(args[0], &numbers->positions, self->positions) &&
        quaternions_are_unit(self, numbers->positions.values) &&
        (args[1] == Py_None || get_row(args[1], &numbers->velocities, self->velocities)) &&
        (args[2] == Py_None || get_row(args[2], &numbers->efforts, self->velocities)))
        return true;
    release_numbers(numbers);
    return false;
}

static PyObject *
encoder_payload(const JointStateEncoder *self, const Numbers *numbers, int64_t stamp, uint64_t seq)
{
    Py_ssize_t size =
        LONGEST_HEAD + numbers->positions.size + numbers->velocities.size + numbers->efforts.size;
    PyObject *payload = PyBytes_FromStringAndSize(NULL, size);
    if (payload == NULL)
        return NULL;
    char *begin = PyBytes_AS_STRING(payload), *at = begin;
    at = put_typed(at, 0x98, 0, 0);
    at = put_signed(at, stamp);
    at = put_unsigned(at, seq);
    at = put_unsigned(at, self->session);
    at = put_bytes(at, self->order, sizeof(self->order));
    at = put_block(at, &numbers->positions);
    at = put_block(at, &numbers->velocities);
    at = put_block(at, &numbers->efforts);
    at = put_typed(at, 0xc0, 0, 0);
    _PyBytes_Resize(&payload, at - begin);
    return payload;
}

static PyObject *
encoder_encode(JointStateEncoder *self, PyObject *const *args, Py_ssize_t count)
{
    Numbers numbers;
    int64_t stamp, seq;
    if (count != 5) {
        PyErr_SetString(PyExc_TypeError, "encode(positions, velocities, efforts, stamp, seq)");
        return NULL;
    }
    if (!plain_stamp(args[3], &stamp) || !plain_stamp(args[4], &seq) || seq < 0 ||
        !get_numbers(self, args, &numbers))
        Py_RETURN_NONE;
    PyObject *payload = encoder_payload(self, &numbers, stamp, (uint64_t)seq);
    release_numbers(&numbers);
    return payload;
}

static PyMethodDef encoder_methods[] = {
    {"encode", (PyCFunction)(void (*)(void))encoder_encode, METH_FASTCALL,
     "encode(positions, velocities, efforts, stamp, seq): the payload; None for anything but "
     "finite numbers in the right count, in flat arrays of doubles, lists or tuples."},
    {NULL},
};

static PyTypeObject JointStateEncoder_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.JointStateEncoder",
    .tp_doc = "The joint states of one writer as bytes.",
    .tp_basicsize = sizeof(JointStateEncoder),
    .tp_new = encoder_new,
    .tp_dealloc = (destructor)encoder_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = encoder_methods,
};

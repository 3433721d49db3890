/* Edges: all edges of a robot from its positions, for JointTransforms in
 * zstate/model/joint_transforms.py. */

typedef struct {
    PyObject_HEAD
    Step *steps;
    Py_ssize_t count;
    Py_ssize_t width; /* how many positions there are */
} Edges;

static PyTypeObject Edges_type;

static int
edges_fill(Edges *self, PyObject *descriptions)
{
    Py_ssize_t count = PyTuple_GET_SIZE(descriptions);
    self->steps = PyMem_New(Step, (size_t)count + 1);
    if (self->steps == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++)
        if (read_step(PyTuple_GET_ITEM(descriptions, i), &self->steps[i]) < 0 ||
            check_step(&self->steps[i], 1, &self->width) < 0)
            return -1;
    self->count = count;
    return 0;
}

static PyObject *
edges_new(PyTypeObject *type, PyObject *args, PyObject *keywords)
{
    static char *names[] = {"width", "steps", NULL};
    Py_ssize_t width;
    PyObject *descriptions;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "nO!:Edges", names, &width, &PyTuple_Type,
                                     &descriptions))
        return NULL;
    if (width < 0 || width > LARGEST_WIDTH) {
        PyErr_SetString(PyExc_ValueError, "a robot has up to 2**20 positions");
        return NULL;
    }
    Edges *self = (Edges *)type->tp_alloc(type, 0);
    if (self == NULL)
        return NULL;
    self->width = width;
    if (edges_fill(self, descriptions) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static void
edges_dealloc(Edges *self)
{
    PyMem_Free(self->steps);
    Py_TYPE(self)->tp_free(self);
}

static void
edges_run(const Edges *self, const double *positions, double *out, Py_ssize_t rows)
{
    for (Py_ssize_t i = 0; i < rows; i++) {
        const Bracket now = {positions, positions, 0.0};
        for (Py_ssize_t k = 0; k < self->count; k++, out += 7) {
            Pose pose = step_pose(&self->steps[k], &now);
            memcpy(out, &pose, sizeof(pose));
        }
        positions += self->width;
    }
}

static PyObject *
edges_poses(Edges *self, PyObject *const *args, Py_ssize_t count)
{
    Py_buffer positions, out;
    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "poses(positions, out)");
        return NULL;
    }
    if (get_doubles(args[0], &positions, 0) < 0)
        return NULL;
    if (get_doubles(args[1], &out, PyBUF_WRITABLE) < 0) {
        PyBuffer_Release(&positions);
        return NULL;
    }
    Py_ssize_t row = 7 * self->count, rows = row == 0 ? 0 : count_of(&out) / row;
    bool fits = rows * row == count_of(&out) && rows * self->width == count_of(&positions);
    if (fits) {
        Py_BEGIN_ALLOW_THREADS edges_run(self, positions.buf, out.buf, rows);
        Py_END_ALLOW_THREADS
    }
    else
        PyErr_SetString(PyExc_ValueError, "each row of positions has seven numbers of each edge");
    PyBuffer_Release(&out);
    PyBuffer_Release(&positions);
    if (!fits)
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef edges_methods[] = {
    {"poses", (PyCFunction)(void (*)(void))edges_poses, METH_FASTCALL,
     "poses(positions, out): parent_from_child of every edge, for each row of positions."},
    {NULL},
};

static PyTypeObject Edges_type = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "zstate._kernel.Edges",
    .tp_doc = "All edges of a robot at once.",
    .tp_basicsize = sizeof(Edges),
    .tp_new = edges_new,
    .tp_dealloc = (destructor)edges_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_methods = edges_methods,
};

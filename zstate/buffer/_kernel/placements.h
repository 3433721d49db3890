/* Poses of placements in Pinocchio's memory, for zstate/model/pinocchio_solver.py. A placement is
 * twelve numbers: its rotation by columns, then its translation. */

#define PLACEMENT 12

/* The unit quaternion of a rotation by columns. Each row of 4 q q^T is a multiple of q; the row of
 * the largest component is never near zero. */
static void
quaternion_of(const double m[9], double q[4])
{
    const double rows[4][4] = {
        {1.0 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6], m[5] - m[7]},
        {m[1] + m[3], 1.0 - m[0] + m[4] - m[8], m[5] + m[7], m[6] - m[2]},
        {m[2] + m[6], m[5] + m[7], 1.0 - m[0] - m[4] + m[8], m[1] - m[3]},
        {m[5] - m[7], m[6] - m[2], m[1] - m[3], 1.0 + m[0] + m[4] + m[8]},
    };
    int largest = 0;
    for (int i = 1; i < 4; i++)
        if (rows[i][i] > rows[largest][largest])
            largest = i;
    const double *row = rows[largest];
    double length = sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]);
    for (int i = 0; i < 4; i++)
        q[i] = row[i] / length;
}

/* parent * placement, as a pose of seven numbers. */
static void
placement_pose(const double *parent, const double *placement, double *pose)
{
    double moved[PLACEMENT];
    for (int column = 0; column < 4; column++) {
        const double *v = placement + 3 * column;
        for (int i = 0; i < 3; i++)
            moved[3 * column + i] = parent[i] * v[0] + parent[3 + i] * v[1] + parent[6 + i] * v[2];
    }
    for (int i = 0; i < 3; i++)
        pose[i] = moved[9 + i] + parent[9 + i];
    quaternion_of(moved, pose + 3);
}

/* -1 and ValueError if a size does not fit, or a row is not one of the placements. Rows are checked
 * as they are read, because the poses may share their memory. */
static int
write_poses(const Py_buffer *placements, const Py_buffer *rows, const Py_buffer *parents,
            const Py_buffer *poses)
{
    Py_ssize_t count = count_of(rows), available = count_of(placements) / PLACEMENT;
    if (count_of(parents) != count * PLACEMENT || count_of(poses) != count * 7) {
        PyErr_SetString(PyExc_ValueError, "each row has a parent of 12 numbers and a pose of 7");
        return -1;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        int64_t row = ((const int64_t *)rows->buf)[i];
        if (row < 0 || row >= available) {
            PyErr_Format(PyExc_ValueError, "there is no placement %lld", (long long)row);
            return -1;
        }
        placement_pose((const double *)parents->buf + PLACEMENT * i,
                       (const double *)placements->buf + PLACEMENT * row,
                       (double *)poses->buf + 7 * i);
    }
    return 0;
}

static PyObject *
placement_poses(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t count)
{
    Py_buffer placements, rows, parents, poses;
    int result = -1;
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "placement_poses(placements, rows, parents, poses)");
        return NULL;
    }
    if (get_doubles(args[0], &placements, 0) < 0)
        return NULL;
    if (get_stamps(args[1], &rows) < 0)
        goto release_placements;
    if (get_doubles(args[2], &parents, 0) < 0)
        goto release_rows;
    if (get_doubles(args[3], &poses, PyBUF_WRITABLE) < 0)
        goto release_parents;
    result = write_poses(&placements, &rows, &parents, &poses);
    PyBuffer_Release(&poses);
release_parents:
    PyBuffer_Release(&parents);
release_rows:
    PyBuffer_Release(&rows);
release_placements:
    PyBuffer_Release(&placements);
    if (result < 0)
        return NULL;
    Py_RETURN_NONE;
}

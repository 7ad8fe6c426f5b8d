"""Loads and stores of vectors: 4 x 4 blocks of an image, columns of a table, transposed rows.

Kernels call functions decorated with ``@intrinsic`` without their first parameter, Numba's
``typing_context``; the other parameters are Numba types when a kernel is compiled.
``emit(context, builder, sig, args)`` writes the LLVM instructions: ``builder`` appends to the kernel's
code, ``args`` are the LLVM values of the parameters. Arrays are contiguous.
"""

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from ghgs_lit.ops.memory import pointer_to
from ghgs_lit.ops.rasterization import layout
from ghgs_lit.ops.simd import DOUBLES, I32, I64, LANES, constant, doubles, everywhere, floats, indices

_FLOAT8 = ir.VectorType(ir.FloatType(), DOUBLES)
_INT8 = ir.VectorType(I32, DOUBLES)


def _block_rows(context, builder, array_type, array, index, stride, index_type):
    """Addresses of the four rows of a 4 x 4 block that starts at ``array[index]`` of a flat float32
    image with rows of ``stride`` floats; ``index_type`` is the Numba type of ``index`` and ``stride``."""
    data = context.make_array(array_type)(context, builder, array).data
    position = context.cast(builder, index, index_type, types.intp)
    step = context.cast(builder, stride, index_type, types.intp)
    kind = ir.VectorType(ir.FloatType(), 4).as_pointer()
    addresses = []
    for _ in range(4):
        addresses.append(builder.bitcast(builder.gep(data, [position]), kind))
        position = builder.add(position, step)
    return addresses


@intrinsic
def load_block(typing_context, array, index, stride):
    """Load a 4 x 4 block of a flat image as a vector of 16 floats, row by row.

    Args:
        typing_context: Numba's.
        array: flat float32 image.
        index: index of the first pixel.
        stride: floats from one row of the image to the next.
    """

    def emit(context, builder, sig, args):
        rows = _block_rows(context, builder, array, *args, index)
        a, b, c, d = (builder.load(row, align=4) for row in rows)
        upper = builder.shuffle_vector(a, b, indices(range(8)))
        lower = builder.shuffle_vector(c, d, indices(range(8)))
        return builder.shuffle_vector(upper, lower, indices(range(16)))

    return floats(array, index, index), emit


@intrinsic
def store_block(typing_context, array, index, stride, value):
    """Write a vector to a 4 x 4 block of a flat image.

    Args:
        typing_context: Numba's.
        array: flat float32 image.
        index: index of the first pixel.
        stride: floats from one row of the image to the next.
        value: 16 floats, row by row.
    """

    def emit(context, builder, sig, args):
        for k, row in enumerate(_block_rows(context, builder, array, *args[:3], index)):
            part = builder.shuffle_vector(args[3], args[3], indices(range(4 * k, 4 * k + 4)))
            builder.store(part, row, align=4)
        return context.get_dummy_value()

    return types.void(array, index, index, floats), emit


def _fold(builder, first, second, width):
    """Add the two halves of every group of ``width`` lanes, a power of two, of two vectors of 16 floats,
    giving one vector."""
    low = [i for i in range(2 * LANES) if i % width < width // 2]
    high = [i + width // 2 for i in low]
    return builder.fadd(
        builder.shuffle_vector(first, second, indices(low)),
        builder.shuffle_vector(first, second, indices(high)),
    )


@intrinsic
def row_sums(typing_context, array):
    """Sum each row of 16 floats in a fixed order; lane ``k`` is the sum of row ``k``.

    Args:
        typing_context: Numba's.
        array: flat float32, aligned to a cache line; rows from ``COLOR + CHANNELS`` on count as 0.
    """

    def emit(context, builder, sig, args):
        rows = []
        for k in range(layout.COLOR + layout.CHANNELS):
            position = ir.Constant(I64, k * LANES)
            address = pointer_to(context, builder, array, args[0], position, types.int64, floats.llvm)
            rows.append(builder.load(address, align=64))
        rows += [constant(floats, 0.0)] * (LANES - len(rows))
        width = LANES
        while len(rows) > 1:
            rows = [_fold(builder, a, b, width) for a, b in zip(rows[::2], rows[1::2], strict=True)]
            width //= 2
        return rows[0]

    return floats(array), emit


def _flat_rows(context, builder, array_type, args, index_type, count, kind):
    """Address, as a pointer to LLVM type ``kind``, of a row of a table with ``count`` columns; ``args``
    starts with the LLVM values of the table and the row."""
    position = builder.mul(
        context.cast(builder, args[1], index_type, types.intp), ir.Constant(args[1].type, count)
    )
    return pointer_to(context, builder, array_type, args[0], position, types.intp, kind)


def _access_rows(builder, name: str, kind, rows, count: int, *args):
    """Load or store the first rows of a vector of eight rows of ``count`` floats.

    Args:
        builder: LLVM IR builder.
        name: ``load`` or ``store``.
        kind: LLVM type of the vector.
        rows: number of rows to load or store, an LLVM integer; more than eight means all.
        count: number of floats of a row.
        args: the address; for a store, preceded by the value.

    Returns:
        For a load, the vector, with 0 in rows that were not loaded.
    """
    wide = ir.VectorType(I64, kind.count)
    lanes = range(kind.count)
    limit = everywhere(builder, rows, kind.count)
    mask = builder.icmp_signed("<", ir.Constant(wide, [lane // count for lane in lanes]), limit)
    values = [v for v in args if v.type == kind]
    align = ir.Constant(I32, 4)
    (address,) = (v for v in args if v.type != kind)
    operands = [*values, address, align, mask] + ([] if values else [ir.Constant(kind, [0.0] * kind.count)])
    result = ir.VoidType() if values else kind
    function = ir.FunctionType(result, [operand.type for operand in operands])
    callee = cgutils.get_or_insert_function(
        builder.module, function, f"llvm.masked.{name}.v{kind.count}f32.p0"
    )
    return builder.call(callee, operands)


def _make_columns(count: int):
    """Make intrinsics that load and store eight rows of a float32 table with ``count`` columns."""
    kind = ir.VectorType(ir.FloatType(), DOUBLES * count)

    @intrinsic
    def columns(typing_context, array, row, last):
        """Load rows ``row`` to ``row + 8`` of a table as one vector of doubles per column; rows from
        ``last`` on are 0.

        Args:
            typing_context: Numba's.
            array: float32 [rows, count].
            row: first row.
            last: end of the rows to read, excluded.
        """

        def emit(context, builder, sig, args):
            address = _flat_rows(context, builder, array, args, row, count, kind)
            lines = _access_rows(builder, "load", kind, builder.sub(args[2], args[1]), count, address)
            values = []
            for k in range(count):
                column = builder.shuffle_vector(lines, lines, indices(range(k, DOUBLES * count, count)))
                values.append(builder.fpext(column, doubles.llvm))
            return context.make_tuple(builder, sig.return_type, values)

        return types.UniTuple(doubles, count)(array, types.int64, types.int64), emit

    @intrinsic
    def store_columns(typing_context, array, row, last, values):
        """Write one vector of doubles per column to rows ``row`` to ``row + 8`` of a table.

        Args:
            typing_context: Numba's.
            array: float32 [rows, count].
            row: first row.
            last: end of the rows to write, excluded.
            values: tuple of ``count`` vectors of eight doubles.
        """

        def emit(context, builder, sig, args):
            columns = cgutils.unpack_tuple(builder, args[3], count)
            lines = _interleave(builder, [builder.fptrunc(column, _FLOAT8) for column in columns])
            address = _flat_rows(context, builder, array, args, row, count, kind)
            _access_rows(builder, "store", kind, builder.sub(args[2], args[1]), count, lines, address)
            return context.get_dummy_value()

        return types.void(array, types.int64, types.int64, types.UniTuple(doubles, count)), emit

    return columns, store_columns


(columns1, store_columns1), (columns3, store_columns3), (columns4, store_columns4) = map(
    _make_columns, (1, 3, 4)
)


def _interleave(builder, columns: list):
    """Concatenate the first lanes of all (eight-lane) columns, then their second lanes, and so on."""
    lines = columns[0]
    for column in columns[1:]:
        # A shuffle needs two vectors of the same length.
        lanes = range(lines.type.count)
        padding = [DOUBLES] * (lines.type.count - DOUBLES)
        column = builder.shuffle_vector(column, column, indices([*range(DOUBLES), *padding]))
        lines = builder.shuffle_vector(
            lines, column, indices([*lanes, *range(len(lanes), len(lanes) + DOUBLES)])
        )
    order = []
    for lane in range(DOUBLES):
        order += range(lane, len(columns) * DOUBLES, DOUBLES)
    return builder.shuffle_vector(lines, lines, indices(order))


@intrinsic
def store_boxes(typing_context, array, row, values):
    """Write four vectors of integral doubles to rows ``row`` to ``row + 8`` of an integer table.

    Args:
        typing_context: Numba's.
        array: int32 [rows, 4].
        row: first row.
        values: tuple of four vectors of eight doubles, one for each column.
    """

    def emit(context, builder, sig, args):
        columns = [builder.fptosi(c, _INT8) for c in cgutils.unpack_tuple(builder, args[2], 4)]
        kind = ir.VectorType(I32, 4 * DOUBLES)
        address = _flat_rows(context, builder, array, args, row, 4, kind)
        builder.store(_interleave(builder, columns), address, align=4)
        return context.get_dummy_value()

    return types.void(array, row, types.UniTuple(doubles, 4)), emit


def _transpose(builder, vectors: list):
    """Transpose 16 vectors, or the two 8 x 8 matrices in the halves of eight vectors."""
    distance = len(vectors) // 2
    while distance > 0:
        low = [i if not i & distance else LANES + i - distance for i in range(LANES)]
        high = [i + distance if not i & distance else LANES + i for i in range(LANES)]
        for j in range(len(vectors)):
            if not j & distance:
                a = vectors[j]
                b = vectors[j + distance]
                vectors[j] = builder.shuffle_vector(a, b, indices(low))
                vectors[j + distance] = builder.shuffle_vector(a, b, indices(high))
        distance //= 2
    return vectors


@intrinsic
def gather_lines(typing_context, array, rows, index):
    """Load 16 rows of 16 floats as one vector per column.

    Args:
        typing_context: Numba's.
        array: float32 [rows, 16], aligned to a cache line.
        rows: indices of rows of ``array``, int64.
        index: position in ``rows`` of the first of 16 indices.
    """

    def emit(context, builder, sig, args):
        lines = []
        for k in range(LANES):
            position = builder.add(args[2], ir.Constant(args[2].type, k))
            place = pointer_to(context, builder, rows, args[1], position, types.int64, I64)
            line = builder.mul(builder.load(place), ir.Constant(I64, LANES))
            address = pointer_to(context, builder, array, args[0], line, types.int64, floats.llvm)
            lines.append(builder.load(address, align=64))
        return context.make_tuple(builder, sig.return_type, _transpose(builder, lines))

    return types.UniTuple(floats, LANES)(array, rows, types.int64), emit


@intrinsic
def store_lines(typing_context, array, row, values):
    """Write up to 16 vectors of doubles as columns of the rows ``row`` to ``row + 8``.

    Args:
        typing_context: Numba's.
        array: float32 [rows, 16], aligned to a cache line; columns without a vector are set to 0.
        row: first row.
        values: tuple of at most 16 vectors of eight doubles.
    """

    def emit(context, builder, sig, args):
        columns = [builder.fptrunc(c, _FLOAT8) for c in cgutils.unpack_tuple(builder, args[2], values.count)]
        columns += [ir.Constant(_FLOAT8, [0.0] * DOUBLES)] * (LANES - len(columns))
        halves = [
            builder.shuffle_vector(columns[j], columns[j + DOUBLES], indices(range(LANES)))
            for j in range(DOUBLES)
        ]
        kind = ir.ArrayType(floats.llvm, DOUBLES)
        address = _flat_rows(context, builder, array, args, row, LANES, kind)
        for j, line in enumerate(_transpose(builder, halves)):
            builder.store(line, builder.gep(address, [ir.Constant(I32, 0), ir.Constant(I32, j)]), align=64)
        return context.get_dummy_value()

    return types.void(array, row, values), emit


@intrinsic
def load_lines(typing_context, array, row):
    """Load eight rows of 16 floats as 16 vectors of doubles, one per column.

    Args:
        typing_context: Numba's.
        array: float32, flat or a table, aligned to a cache line.
        row: first row.
    """

    def emit(context, builder, sig, args):
        kind = ir.ArrayType(floats.llvm, DOUBLES)
        address = _flat_rows(context, builder, array, args, types.int64, LANES, kind)
        places = [builder.gep(address, [ir.Constant(I32, 0), ir.Constant(I32, j)]) for j in range(DOUBLES)]
        lines = [builder.load(place, align=64) for place in places]
        halves = _transpose(builder, lines)
        values = []
        for k in range(LANES):
            first = k // DOUBLES * DOUBLES
            half = halves[k % DOUBLES]
            part = builder.shuffle_vector(half, half, indices(range(first, first + DOUBLES)))
            values.append(builder.fpext(part, doubles.llvm))
        return context.make_tuple(builder, sig.return_type, values)

    return types.UniTuple(doubles, LANES)(array, types.int64), emit

/* The loop of nearest.c for one kind of processor, which the names in capitals describe. */

#define COLUMNS (LANES * VECTORS)

TARGET static int NAMED(nearest, VARIANT)(const int8_t *a, size_t n, const int8_t *b, size_t m,
                                          size_t dim, int32_t *best, int32_t *best_column,
                                          int32_t *second, int32_t *column_best) {
    const size_t steps = (dim + STEP - 1) / STEP, width = steps * STEP;
    const size_t groups = (n + ROWS - 1) / ROWS;
    /* a, filled up to whole groups and steps, and the products of each row with OFFSET. */
    A_NUMBER *rows = calloc(groups * ROWS * width, sizeof *rows);
    int32_t *offsets = calloc(groups * ROWS, sizeof *offsets);
    B_NUMBER *columns = aligned_alloc(64, width * COLUMNS * sizeof *columns);
    if (!rows || !offsets || !columns) {
        free(rows), free(offsets), free(columns);
        return 1;
    }
    for (size_t i = 0; i < n; i++) {
        for (size_t k = 0; k < dim; k++) {
            rows[i * width + k] = a[i * dim + k];
            offsets[i] -= OFFSET * a[i * dim + k];
        }
        best[i] = INT32_MIN;
        best_column[i] = 0;
        if (second) second[i] = INT32_MIN;
    }
    const int32_t *limits = second ? second : best; /* a product above it is news */

    for (size_t first = 0; first < m; first += COLUMNS) {
        const size_t count = m - first < COLUMNS ? m - first : COLUMNS;
        /* Columns side by side, STEP numbers of each at a time. The last one fills the tile up:
         * its products are not larger than its own. */
        for (size_t c = 0; c < COLUMNS; c++) {
            const int8_t *from = b + (first + (c < count ? c : count - 1)) * dim;
            for (size_t k = 0; k < width; k++)
                columns[(k / STEP * COLUMNS + c) * STEP + k % STEP] =
                    (B_NUMBER)((k < dim ? from[k] : 0) + OFFSET);
        }
        VECTOR largest[VECTORS];
        for (int v = 0; v < VECTORS; v++) largest[v] = EVERYWHERE(INT32_MIN);

        for (size_t group = 0; group < n; group += ROWS) {
            VECTOR products[ROWS][VECTORS];
#pragma GCC unroll 8
            for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 4
                for (int v = 0; v < VECTORS; v++)
                    products[r][v] = EVERYWHERE(offsets[group + r]);
            const A_NUMBER *row = rows + group * width;
            const VECTOR *column = (const VECTOR *)columns;
            for (size_t step = 0; step < steps; step++, row += STEP, column += VECTORS) {
                VECTOR at[VECTORS];
#pragma GCC unroll 4
                for (int v = 0; v < VECTORS; v++) at[v] = column[v];
#pragma GCC unroll 8
                for (int r = 0; r < ROWS; r++) {
                    int32_t numbers;
                    memcpy(&numbers, row + r * width, sizeof numbers);
                    const VECTOR everywhere = EVERYWHERE(numbers);
#pragma GCC unroll 4
                    for (int v = 0; v < VECTORS; v++) {
                        products[r][v] = ADD_PRODUCTS(products[r][v], everywhere, at[v]);
                        /* One after the other: together they need more registers than there are. */
                        __asm__("" : "+v"(products[r][v]));
                    }
                }
            }
#pragma GCC unroll 8
            for (int r = 0; r < ROWS; r++) {
                const size_t i = group + r;
                if (i >= n) break;
                const VECTOR limit = EVERYWHERE(limits[i]);
#pragma GCC unroll 4
                for (int v = 0; v < VECTORS; v++)
                    largest[v] = LARGER(largest[v], products[r][v]);
                VECTOR row_largest = products[r][0];
#pragma GCC unroll 4
                for (int v = 1; v < VECTORS; v++)
                    row_largest = LARGER(row_largest, products[r][v]);
                if (!ANY_ABOVE(row_largest, limit)) continue; /* nearly always */
                int32_t stored[COLUMNS];
                memcpy(stored, products[r], sizeof stored);
                note(stored, count, first, best + i, best_column + i, second ? second + i : NULL);
            }
        }
        memcpy(column_best + first, largest, count * sizeof *column_best);
    }
    free(rows), free(offsets), free(columns);
    return 0;
}

#undef COLUMNS
#undef VARIANT
#undef TARGET
#undef LANES
#undef VECTORS
#undef STEP
#undef OFFSET
#undef A_NUMBER
#undef B_NUMBER
#undef VECTOR
#undef EVERYWHERE
#undef ADD_PRODUCTS
#undef LARGER
#undef ANY_ABOVE

/* Nearest neighbours of descriptors in 8 bits: products and their largest in one pass.
 *
 * A tile of products never leaves the registers: its largest are kept, and the products are
 * forgotten. kernel.h is the loop; this file says how each kind of processor multiplies, and which
 * kind this one is. Products are exact, so all kinds give the same answer.
 */

#include <immintrin.h>
#include <limits.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define ROWS 6 /* of a tile: with its columns they fill the registers */
#define JOINED(a, b) a##_##b
#define NAMED(a, b) JOINED(a, b)

/* Takes over the largest of one row's products, at columns from `column`; the first of equal ones.
 * second may be NULL. */
static void note(const int32_t *products, size_t count, size_t column, int32_t *best,
                 int32_t *best_column, int32_t *second) {
    for (size_t c = 0; c < count; c++) {
        if (products[c] > *best) {
            if (second) *second = *best;
            *best = products[c];
            *best_column = (int32_t)(column + c);
        } else if (second && products[c] > *second) {
            *second = products[c];
        }
    }
}

/* AVX2: pairs of 16-bit numbers are multiplied and added up in 32 bits. */
#define VARIANT avx2
#define TARGET __attribute__((target("avx2")))
#define LANES 8
#define VECTORS 2
#define STEP 2
#define OFFSET 0
#define A_NUMBER int16_t
#define B_NUMBER int16_t
#define VECTOR __m256i
#define EVERYWHERE(x) _mm256_set1_epi32(x)
#define ADD_PRODUCTS(sum, row, columns) _mm256_add_epi32(sum, _mm256_madd_epi16(row, columns))
#define LARGER(x, y) _mm256_max_epi32(x, y)
#define ANY_ABOVE(x, y) _mm256_movemask_epi8(_mm256_cmpgt_epi32(x, y))
#include "kernel.h"

/* AVX-512 VNNI: four 8-bit products at a time, of numbers without a sign (here the columns, 128 too
 * large) and numbers with one. */
#define VARIANT vnni
#define TARGET __attribute__((target("avx512f,avx512bw,avx512vnni")))
#define LANES 16
#define VECTORS 4
#define STEP 4
#define OFFSET 128
#define A_NUMBER int8_t
#define B_NUMBER uint8_t
#define VECTOR __m512i
#define EVERYWHERE(x) _mm512_set1_epi32(x)
#define ADD_PRODUCTS(sum, row, columns) _mm512_dpbusd_epi32(sum, columns, row)
#define LARGER(x, y) _mm512_max_epi32(x, y)
#define ANY_ABOVE(x, y) _mm512_cmpgt_epi32_mask(x, y)
#include "kernel.h"

/* 2 where the processor has AVX-512 VNNI, 1 where it has AVX2, else 0. */
int visloc_nearest_level(void) {
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vnni"))
        return 2;
    return __builtin_cpu_supports("avx2") ? 1 : 0;
}

/* For each row of a (n, dim): its largest product with a row of b (m, dim), and the first row of b
 * that gives it; with `second` also the second largest, INT32_MIN where b has one row. For each row
 * of b its largest product. level is at most visloc_nearest_level() and above 0; n, m and dim are
 * above 0, and dim at most 65 535, so that no sum leaves 32 bits. Returns 0, or 1 without memory. */
int visloc_nearest(int level, const int8_t *a, size_t n, const int8_t *b, size_t m, size_t dim,
                   int32_t *best, int32_t *best_column, int32_t *second, int32_t *column_best) {
    return (level == 2 ? nearest_vnni : nearest_avx2)(a, n, b, m, dim, best, best_column, second,
                                                      column_best);
}

/* The search of the spatial index. Every operation rounds as NumPy's does: results are equal. */
#include <math.h>
#include <stdint.h>

enum { BLOCK = 512 };

/* Of each trajectory the row nearest to a point, the first on ties, within `radius`.
 *
 * parts: runs [starts, stops) of the sorted rows. columns: one or two coordinates of each, `order`
 * its row, `episodes` its trajectory. first_usable: the first row of each trajectory that counts, or
 * NULL. distances and rows: of each trajectory, to begin with infinity and anything. */
void nearest_per_episode(int64_t parts, const int64_t *starts, const int64_t *stops,
                      const float *const *columns, int64_t dims, const double *point,
                      const double *scale, double radius, const int32_t *order,
                      const int32_t *episodes, const int64_t *first_usable, double *distances,
                      int64_t *rows)
{
    double distance[BLOCK];
    int32_t inside[BLOCK];
    for (int64_t part = 0; part < parts; part++) {
        for (int64_t from = starts[part]; from < stops[part]; from += BLOCK) {
            const int64_t left = stops[part] - from, count = left < BLOCK ? left : BLOCK;
            const float *x = columns[0] + from, *y = columns[dims - 1] + from;
            const double two = dims > 1;
#pragma omp simd
            for (int64_t i = 0; i < count; i++) {
                const double dx = (x[i] - point[0]) * scale[0];
                const double dy = two * ((y[i] - point[dims - 1]) * scale[dims - 1]);
                distance[i] = sqrt(dx * dx + dy * dy);
            }
            int64_t hits = 0;
            for (int64_t i = 0; i < count; i++) { /* without a branch to guess wrong */
                inside[hits] = (int32_t)i;
                hits += distance[i] <= radius;
            }
            for (int64_t hit = 0; hit < hits; hit++) {
                const int64_t i = inside[hit], episode = episodes[from + i], row = order[from + i];
                if (first_usable && row < first_usable[episode])
                    continue;
                if (distance[i] < distances[episode] ||
                    (distance[i] == distances[episode] && row < rows[episode])) {
                    distances[episode] = distance[i];
                    rows[episode] = row;
                }
            }
        }
    }
}

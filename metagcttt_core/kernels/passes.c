/* The passes of a multilayer perceptron and Adam's step, fused between the matrix products, which
 * are left to the BLAS library that PyTorch brings along. All arrays are row-major float32. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void sgemm_t(const char *, const char *, const int *, const int *, const int *,
                     const float *, const float *, const int *, const float *, const int *,
                     const float *, float *, const int *);

/* A linear layer (outputs, inputs) and, but for the head, GELU and perhaps a layer norm after it.
 * Mirrored field by field in __init__.py. */
struct layer {
    int64_t inputs, outputs;
    const float *weight, *bias, *scale, *shift;             /* the latter two: NULL, no norm */
    float *weight_slope, *bias_slope, *scale_slope, *shift_slope; /* gradients of the loss */
    float *output;                  /* (rows, outputs); the head's is the caller's */
    float *gelu_slope, *normed, *inverse_std; /* what the backward pass needs */
};

/* e^x to 2 units in the last place, in arithmetic that compilers vectorise. */
static inline float exponential(float x)
{
    x = x > 88.0f ? 88.0f : x;
    x = x < -87.0f ? -87.0f : x;
    const float n = rintf(x * 1.44269504f);
    const float r = fmaf(n, -1.42860677e-6f, fmaf(n, -0.693145752f, x));
    float p = 1.38888889e-3f;
    p = fmaf(p, r, 8.33333333e-3f);
    p = fmaf(p, r, 4.16666667e-2f);
    p = fmaf(p, r, 0.166666667f);
    p = fmaf(p, r, 0.5f);
    p = fmaf(p, r, 1.0f);
    p = fmaf(p, r, 1.0f);
    union { int32_t bits; float value; } power = {.bits = ((int32_t)n + 127) << 23};
    return p * power.value;
}

/* GELU in its tanh form is z sigmoid(u), u = z (a + b z^2): adds the bias, in place. */
static void gelu(int64_t units, float *restrict z, const float *restrict bias,
                 float *restrict slope)
{
    const float a = 1.59576912f, b = 0.0713548163f;
#pragma omp simd
    for (int64_t j = 0; j < units; j++) {
        const float x = z[j] + bias[j], square = x * x;
        const float s = 1.0f / (1.0f + exponential(-x * fmaf(b, square, a)));
        const float h = x * s;
        z[j] = h;
        slope[j] = fmaf(h * (1.0f - s), fmaf(3.0f * b, square, a), s);
    }
}

static float normalize(int64_t units, float *restrict h, const float *restrict scale,
                       const float *restrict shift, float *restrict normed)
{
    float sum = 0.0f, squares = 0.0f;
#pragma omp simd reduction(+ : sum)
    for (int64_t j = 0; j < units; j++)
        sum += h[j];
    const float mean = sum / units;
#pragma omp simd reduction(+ : squares)
    for (int64_t j = 0; j < units; j++)
        squares += (h[j] - mean) * (h[j] - mean);
    const float inverse_std = 1.0f / sqrtf(squares / units + 1e-6f);
#pragma omp simd
    for (int64_t j = 0; j < units; j++) {
        const float x = (h[j] - mean) * inverse_std;
        normed[j] = x;
        h[j] = fmaf(x, scale[j], shift[j]);
    }
    return inverse_std;
}

/* What follows the product of a hidden layer, for one row in place; the inverse deviation. */
static float activate_row(const struct layer *layer, float *row, float *slope, float *normed)
{
    gelu(layer->outputs, row, layer->bias, slope);
    return layer->scale ? normalize(layer->outputs, row, layer->scale, layer->shift, normed)
                        : 0.0f;
}

/* The same for all rows: `output` holds the product and gets the result. */
void activate(const struct layer *layer, int64_t rows)
{
    const int64_t units = layer->outputs;
    for (int64_t i = 0; i < rows; i++) {
        float *normed = layer->scale ? layer->normed + i * units : NULL;
        const float inverse_std = activate_row(layer, layer->output + i * units,
                                               layer->gelu_slope + i * units, normed);
        if (layer->scale)
            layer->inverse_std[i] = inverse_std;
    }
}

/* The same without a backward pass to come: `room` holds two rows, of what that would need. */
void activate_only(const struct layer *layer, int64_t rows, float *product, float *room)
{
    for (int64_t i = 0; i < rows; i++)
        activate_row(layer, product + i * layer->outputs, room, room + layer->outputs);
}

static void unnormalize(const struct layer *layer, float *restrict g,
                        const float *restrict normed, float inverse_std, int weights)
{
    const int64_t units = layer->outputs;
    const float *restrict scale = layer->scale;
    float *restrict scale_slope = layer->scale_slope, *restrict shift_slope = layer->shift_slope;
    float sum = 0.0f, dot = 0.0f;
    if (weights) {
#pragma omp simd
        for (int64_t j = 0; j < units; j++) {
            scale_slope[j] += g[j] * normed[j];
            shift_slope[j] += g[j];
        }
    }
#pragma omp simd reduction(+ : sum, dot)
    for (int64_t j = 0; j < units; j++) {
        g[j] *= scale[j];
        sum += g[j];
        dot += g[j] * normed[j];
    }
    sum /= units;
    dot /= units;
#pragma omp simd
    for (int64_t j = 0; j < units; j++)
        g[j] = inverse_std * (g[j] - sum - normed[j] * dot);
}

/* Take a gradient (rows, outputs) back through `activate`, in place; with `weights` set those of
 * bias, scale and shift. */
void activate_backward(const struct layer *layer, int64_t rows, float *gradient, int weights)
{
    const int64_t units = layer->outputs;
    if (weights) {
        memset(layer->bias_slope, 0, units * sizeof(float));
        if (layer->scale) {
            memset(layer->scale_slope, 0, units * sizeof(float));
            memset(layer->shift_slope, 0, units * sizeof(float));
        }
    }
    for (int64_t i = 0; i < rows; i++) {
        float *restrict g = gradient + i * units;
        const float *restrict slope = layer->gelu_slope + i * units;
        float *restrict bias_slope = layer->bias_slope;
        if (layer->scale)
            unnormalize(layer, g, layer->normed + i * units, layer->inverse_std[i], weights);
        if (weights) {
#pragma omp simd
            for (int64_t j = 0; j < units; j++) {
                g[j] *= slope[j];
                bias_slope[j] += g[j];
            }
        } else {
#pragma omp simd
            for (int64_t j = 0; j < units; j++)
                g[j] *= slope[j];
        }
    }
}

/* (m, n) <- (m, k) times (k, n), either of them as its transpose; BLAS counts by columns. */
static void multiply(sgemm_t *sgemm, char left_as, char right_as, int64_t m, int64_t n, int64_t k,
                     const float *left, const float *right, float *into)
{
    const int rows = (int)m, columns = (int)n, inner = (int)k;
    const int left_stride = left_as == 'N' ? inner : rows;
    const int right_stride = right_as == 'N' ? columns : inner;
    const float one = 1.0f, zero = 0.0f;
    sgemm(&right_as, &left_as, &columns, &rows, &inner, &one, right, &right_stride, left,
          &left_stride, &zero, into, &columns);
}

/* The gradient of a layer's weight. BLAS is slow where its result is only a few columns wide. */
static void weight_gradient(sgemm_t *sgemm, const struct layer *layer, int64_t rows,
                            const float *gradient, const float *seen)
{
    const int64_t n = layer->inputs, m = layer->outputs;
    float *turned = n < 16 ? malloc(m * n * sizeof(float)) : NULL;
    if (!turned) {
        multiply(sgemm, 'T', 'N', m, n, rows, gradient, seen, layer->weight_slope);
        return;
    }
    multiply(sgemm, 'T', 'N', n, m, rows, seen, gradient, turned);
    for (int64_t i = 0; i < m; i++)
        for (int64_t j = 0; j < n; j++)
            layer->weight_slope[i * n + j] = turned[j * m + i];
    free(turned);
}

static void add_bias(const struct layer *head, int64_t rows, float *outputs)
{
    for (int64_t r = 0; r < rows; r++)
        for (int64_t j = 0; j < head->outputs; j++)
            outputs[r * head->outputs + j] += head->bias[j];
}

/* Map inputs (rows, in) to outputs (rows, out) through `count` layers, the last a head. */
void forward(sgemm_t *sgemm, const struct layer *layers, int64_t count, int64_t rows,
             const float *inputs, float *outputs)
{
    for (int64_t i = 0; i < count; i++) {
        const struct layer *layer = layers + i;
        const int is_head = i == count - 1;
        float *into = is_head ? outputs : layer->output;
        multiply(sgemm, 'N', 'T', rows, layer->outputs, layer->inputs, inputs, layer->weight,
                 into);
        if (is_head)
            add_bias(layer, rows, outputs);
        else
            activate(layer, rows);
        inputs = into;
    }
}

/* The same without a backward pass to come, so many rows at a time as `room` holds twice, and two
 * more: 2 (block + 1) rows of the widest hidden layer. */
void evaluate(sgemm_t *sgemm, const struct layer *layers, int64_t count, int64_t rows,
              const float *inputs, float *outputs, int64_t block, int64_t widest, float *room)
{
    const struct layer *head = layers + count - 1;
    float *const halves[] = {room, room + block * widest}, *scratch = room + 2 * block * widest;
    for (int64_t done = 0; done < rows; done += block) {
        const int64_t some = rows - done < block ? rows - done : block;
        const float *from = inputs + done * layers->inputs;
        for (int64_t i = 0; i < count; i++) {
            const struct layer *layer = layers + i;
            float *into = layer == head ? outputs + done * head->outputs : halves[i % 2];
            multiply(sgemm, 'N', 'T', some, layer->outputs, layer->inputs, from, layer->weight,
                     into);
            if (layer == head)
                add_bias(head, some, into);
            else
                activate_only(layer, some, into, scratch);
            from = into;
        }
    }
}

/* Take a gradient (rows, out) of the last forward pass back; to its inputs if `into` is given.
 * Overwrites what that pass kept. */
void backward(sgemm_t *sgemm, const struct layer *layers, int64_t count, int64_t rows,
              const float *inputs, const float *gradient, float *into, int weights)
{
    const struct layer *head = layers + count - 1;
    if (weights) {
        memset(head->bias_slope, 0, head->outputs * sizeof(float));
        for (int64_t r = 0; r < rows; r++)
            for (int64_t j = 0; j < head->outputs; j++)
                head->bias_slope[j] += gradient[r * head->outputs + j];
    }
    for (int64_t i = count - 1; i >= 0; i--) {
        const struct layer *layer = layers + i;
        const float *seen = i ? layers[i - 1].output : inputs;
        if (weights)
            weight_gradient(sgemm, layer, rows, gradient, seen);
        float *below = i ? layers[i - 1].output : into;
        if (!below)
            break;
        multiply(sgemm, 'N', 'N', rows, layer->inputs, layer->outputs, gradient, layer->weight,
                 below);
        if (i)
            activate_backward(layers + i - 1, rows, below, weights);
        gradient = below;
    }
}

/* Adam's step on `arrays` weights; eps is added after the bias correction, as in PyTorch. */
void adam(int64_t arrays, const int64_t *sizes, float *const *weights,
          const float *const *gradients, float *const *means, float *const *squares, double beta1,
          double beta2, double step_size, double correction, double eps)
{
    const float new_mean = (float)(1 - beta1), old_square = (float)beta2;
    const float new_square = (float)(1 - beta2), rate = (float)step_size;
    const float inverse = (float)(1 / correction), least = (float)eps;
    for (int64_t n = 0; n < arrays; n++) {
        float *restrict w = weights[n], *restrict mean = means[n], *restrict square = squares[n];
        const float *restrict gradient = gradients[n];
#pragma omp simd
        for (int64_t i = 0; i < sizes[n]; i++) {
            const float g = gradient[i];
            mean[i] += new_mean * (g - mean[i]);
            square[i] = old_square * square[i] + new_square * g * g;
            w[i] -= rate * mean[i] / (sqrtf(square[i]) * inverse + least);
        }
    }
}

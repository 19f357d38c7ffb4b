// Functions of single numbers and sums of rows, for the parts of a network around its products.
#include "../elements.h"

#include "activations.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;

// Replaces each number by apply(register).
template <typename Apply>
void replace(float* x, int64_t n, Apply apply) {
  int64_t k = 0;
  for (; k + kL <= n; k += kL) store(x + k, apply(load<Floats>(x + k)));
  if (k < n) store_first(x + k, apply(load_first(x + k, n - k)), n - k);
}

void add(const float* x, float* to, int64_t n) {
  int64_t k = 0;
  for (; k + kL <= n; k += kL) store(to + k, load<Floats>(to + k) + load<Floats>(x + k));
  for (; k < n; ++k) to[k] += x[k];
}

void add_rows(const float* x, int64_t rows, int64_t n, float* to) {
  constexpr int64_t kRun = 32;  // rows whose sum is taken first, because long sums round more
  for (int64_t c = 0; c < n; c += kL) {
    const int64_t count = smaller(kL, n - c);
    Floats all = load_first(to + c, count);
    for (int64_t row = 0; row < rows; row += kRun) {
      Floats run{};
      for (int64_t k = row; k < smaller(row + kRun, rows); ++k) {
        run += load_first(x + k * n + c, count);
      }
      all += run;
    }
    store_first(to + c, all, count);
  }
}

void gelu_all(float* x, int64_t n) {
  replace(x, n, [](Floats v) { return gelu(v); });
}

void relu_all(float* x, int64_t n) {
  replace(x, n, [](Floats v) { return relu(v); });
}

void derive_gelu(float* x, float* grad, int64_t n) {
  for (int64_t k = 0; k < n; k += kL) {
    const int64_t count = smaller(kL, n - k);
    const Gelu gelu = derived_gelu(load_first(x + k, count));
    store_first(grad + k, load_first(grad + k, count) * gelu.derivative, count);
    store_first(x + k, gelu.value, count);
  }
}

void largest(const float* x, float* to, int64_t n) {
  const auto at = [&]<typename V>(int64_t k) {
    const V one = load<V>(x + k), other = load<V>(to + k);
    store(to + k, other >= one || other != other ? other : one);
  };
  int64_t k = 0;
  for (; k + kL <= n; k += kL) at.template operator()<Floats>(k);
  for (; k < n; ++k) at.template operator()<float>(k);
}

// tanh(y) = (1 - e) / (1 + e) with e = e^(-2 |y|), and e^z = 1 / e^-z for positive z. Around 0 the
// difference 1 - e loses digits of tanh, but the distance depends on 8 tanh(y) as a whole.
void distance(float* x, int64_t n, float typical) {
  replace(x, n, [typical](Floats v) {
    constexpr float kLargest = 8;
    const Floats size = v < 0 ? -v : v;
    const Floats e = exponential_of_negative(size * (-2 / kLargest));
    const Floats exponent = kLargest * (1 - e) / (1 + e);
    const Floats inverse = exponential_of_negative(-exponent);
    return typical * (v < 0 ? inverse : 1 / inverse);
  });
}

void mix(const float* const from[4], const float weights[4], float* to, int64_t n) {
  const auto at = [&]<typename V>(int64_t k) {
    const V inner = weights[0] * load<V>(from[0] + k) + weights[1] * load<V>(from[1] + k);
    const V outer = weights[2] * load<V>(from[2] + k) + weights[3] * load<V>(from[3] + k);
    store(to + k, inner + outer);
  };
  int64_t k = 0;
  for (; k + kL <= n; k += kL) at.template operator()<Floats>(k);
  for (; k < n; ++k) at.template operator()<float>(k);
}

}  // namespace

TIER_TABLE(ElementKernels) = {.add = add,
                              .add_rows = add_rows,
                              .gelu = gelu_all,
                              .relu = relu_all,
                              .derive_gelu = derive_gelu,
                              .largest = largest,
                              .distance = distance,
                              .mix = mix};

}  // namespace darswin

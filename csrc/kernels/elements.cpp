// Functions of single numbers and sums of rows, for the parts of a network around its products.
#include "../elements.h"

#include "activations.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;

// Replaces each number by apply(register). The last registers overlap nothing: a short rest goes
// through a register of its own.
template <typename Apply>
void replace(float* x, int64_t n, Apply apply) {
  int64_t k = 0;
  for (; k + kL <= n; k += kL) store(x + k, apply(load<Floats>(x + k)));
  if (k == n) return;
  float rest[kL] = {};
  for (int64_t e = k; e < n; ++e) rest[e - k] = x[e];
  store(rest, apply(load<Floats>(rest)));
  for (int64_t e = k; e < n; ++e) x[e] = rest[e - k];
}

void add(const float* x, float* to, int64_t n) {
  int64_t k = 0;
  for (; k + kL <= n; k += kL) store(to + k, load<Floats>(to + k) + load<Floats>(x + k));
  for (; k < n; ++k) to[k] += x[k];
}

void gelu_all(float* x, int64_t n) {
  replace(x, n, [](Floats v) { return gelu(v); });
}

void relu_all(float* x, int64_t n) {
  replace(x, n, [](Floats v) { return relu(v); });
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
                              .gelu = gelu_all,
                              .relu = relu_all,
                              .largest = largest,
                              .distance = distance,
                              .mix = mix};

}  // namespace darswin

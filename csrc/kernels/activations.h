// The GELU and the ReLU, which products and other kernels share.
#pragma once

#include "math.h"

namespace darswin {
namespace {

// Returns 1 - Phi(|x|), where Phi is the normal distribution, from e^(-x^2 / 2). The quotient of
// the two is a polynomial of 1 / (1 + p |x|), which is fitted for the least relative error.
inline Floats normal_tail(Floats x, Floats exponential) {
  const Floats size = x < 0 ? -x : x;
  const Floats t = 1 / (1 + 0.35f * size);
  constexpr float terms[] = {-2.91455662e-2f, 1.43970054e-1f,  -2.55711114e-1f,
                             1.59170855e-1f,  -2.31077446e-2f, 1.05507193e-1f,
                             1.19833056e-1f,  1.39861846e-1f,  1.39621406e-1f};
  Floats tail = splat<Floats>(terms[0]);
#pragma GCC unroll 16
  for (std::size_t k = 1; k < sizeof(terms) / sizeof(float); ++k) tail = tail * t + terms[k];
  return tail * t * exponential;
}

// A GELU, x Phi(x), and its derivative, Phi(x) + x Phi'(x).
struct Gelu {
  Floats value, derivative;
};
inline Gelu derived_gelu(Floats x) {
  const Floats exponential = exponential_of_negative(x * x * -0.5f);
  const Floats tail = normal_tail(x, exponential), phi = x < 0 ? tail : 1 - tail;
  return {x * phi, phi + x * 0.3989422804f * exponential};  // the value is right at infinity, too
}
inline Floats gelu(Floats x) { return derived_gelu(x).value; }

// NaN stays.
inline Floats relu(Floats x) { return x < 0 ? Floats{} : x; }

}  // namespace
}  // namespace darswin

// The GELU and the ReLU, which products and other kernels share.
#pragma once

#include "math.h"

namespace darswin {
namespace {

// Computes x Phi(x), where Phi is the normal distribution. 1 - Phi(|x|) equals e^(-x^2 / 2) times a
// polynomial of 1 / (1 + p |x|), which is fitted for the least relative error.
inline Floats gelu(Floats x) {
  const Floats size = x < 0 ? -x : x;
  const Floats t = 1 / (1 + 0.35f * size);
  constexpr float terms[] = {-2.91455662e-2f, 1.43970054e-1f,  -2.55711114e-1f,
                             1.59170855e-1f,  -2.31077446e-2f, 1.05507193e-1f,
                             1.19833056e-1f,  1.39861846e-1f,  1.39621406e-1f};
  Floats tail = splat<Floats>(terms[0]);
#pragma GCC unroll 16
  for (std::size_t k = 1; k < sizeof(terms) / sizeof(float); ++k) tail = tail * t + terms[k];
  tail = tail * t * exponential_of_negative(size * size * -0.5f);
  return x < 0 ? x * tail : x * (1 - tail);  // also right at infinity
}

// NaN stays.
inline Floats relu(Floats x) { return x < 0 ? Floats{} : x; }

}  // namespace
}  // namespace darswin

// What the tiers with registers of 128 bits share.
#pragma once

#include "../vector.h"

namespace darswin {
namespace {

constexpr int kRegister = 16;  // bytes

using Floats = Vector<float, 4>;
using Doubles = Vector<double, 2>;
using Words = Vector<uint64_t, 2>;

// Repeats four lanes in every 128 bits of a register.
inline Floats repeat(Vector<float, 4> v) { return v; }

// Load and store the first lanes of a register, 0 to all of them. The other lanes are 0.
inline Floats load_first(const float* from, int64_t count) {
  Floats v{};
  for (int64_t lane = 0; lane < count; ++lane) v[lane] = from[lane];
  return v;
}
inline void store_first(float* to, Floats v, int64_t count) {
  for (int64_t lane = 0; lane < count; ++lane) to[lane] = v[lane];
}

// Joins the floats at from[at[0]], from[at[1]], ...
inline Floats gathered(const float* from, const int32_t* at) {
  return Floats{from[at[0]], from[at[1]], from[at[2]], from[at[3]]};
}

}  // namespace
}  // namespace darswin

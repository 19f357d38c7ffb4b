// The types of numbers that drivers and kernels share.
#pragma once

#include <cstdint>
#include <type_traits>

namespace darswin {
namespace {

// Returns how many units n takes up.
constexpr int64_t units(int64_t n, int64_t unit) { return (n + unit - 1) / unit; }
// Rounds n up to a multiple of `unit`.
constexpr int64_t round_up(int64_t n, int64_t unit) { return units(n, unit) * unit; }

}  // namespace

// The upper half of a float32.
struct bfloat16 {
  uint16_t bits;
};

// The type used to compute with numbers of a storage type.
template <typename T>
using Arithmetic = std::conditional_t<std::is_same_v<T, bfloat16>, float, T>;

// Converts numbers to 8 bits: round(x / scale) + zero_point, clamped to 0 ... 255.
struct Quantizer {
  float steps = 1;  // 1 / scale
  int32_t zero_point = 0;
};

}  // namespace darswin

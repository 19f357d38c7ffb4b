// What the drivers ask of their arguments. The checks only keep memory safe; darswin/ops explains
// wrong arguments. `name` is the operator's, for messages.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <initializer_list>
#include <optional>
#include <vector>

#include "numbers.h"

namespace darswin {

using torch::headeronly::ScalarType;
using torch::stable::contiguous, torch::stable::new_empty, torch::stable::new_zeros;
using torch::stable::Tensor;
using MaybeTensor = std::optional<Tensor>;
using Sizes = std::vector<int64_t>;

inline MaybeTensor contiguous(const MaybeTensor& tensor) {
  return tensor ? MaybeTensor(contiguous(*tensor)) : tensor;
}

// A tensor of no values, where a gradient is not asked for.
inline Tensor nothing_like(const Tensor& tensor) { return new_empty(tensor, Sizes{0}); }

// The type of tensors of T, float or double.
template <typename T>
constexpr ScalarType type_of() {
  return sizeof(T) == sizeof(float) ? ScalarType::Float : ScalarType::Double;
}

template <typename T>
const T* pointer(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}
template <typename T>
T* mutable_pointer(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}

// RuntimeError unless 64 times the product of the sizes above 0 fits 64 bits. None is negative.
inline void check_product(std::initializer_list<int64_t> sizes) {
  int64_t result = 64;
  for (const int64_t size : sizes) {
    STD_TORCH_CHECK(size == 0 || !__builtin_mul_overflow(result, size, &result),
                    "the sizes are too large");
  }
}

// How many rows a tensor has that must be (B or 1, sizes...), on the CPU and of T. `names` says
// which tensors it is one of.
template <typename T>
int64_t count_rows(const Tensor& tensor, int64_t batch, const Sizes& sizes, const char* names) {
  const Sizes given = tensor.sizes().vec();
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == type_of<T>() &&
                      given.size() == sizes.size() + 1 && (given[0] == 1 || given[0] == batch) &&
                      std::equal(sizes.begin(), sizes.end(), given.begin() + 1),
                  "wrong type, device or shape of ", names);
  return given[0];
}

// An output's gradient, contiguous: gradients arrive expanded or strided, `.sum().backward()` gives
// stride 0.
inline Tensor checked_gradient(const Tensor& grad, const Sizes& sizes, ScalarType type,
                               const char* name) {
  STD_TORCH_CHECK(grad.is_cpu() && grad.scalar_type() == type && grad.sizes().vec() == sizes, name,
                  "_backward: grad_out must look like the output");
  return contiguous(grad);
}

inline Quantizer quantizer(double scale, int64_t zero_point) {
  const double steps = 1 / scale;
  STD_TORCH_CHECK(steps >= 1e-30 && steps <= 1e30 && zero_point >= 0 && zero_point <= 255,
                  "scale must be in 1e-30 ... 1e30, zero_point in 0 ... 255");
  return {static_cast<float>(steps), static_cast<int32_t>(zero_point)};
}

// The gradient of `like`, from doubles that were added up in a fixed order.
template <typename T>
Tensor rounded_like(const Tensor& like, const std::vector<double>& sums) {
  const Tensor grad = new_empty(like, like.sizes());
  std::copy(sums.begin(), sums.end(), mutable_pointer<T>(grad));
  return grad;
}

// use<T>() with T the type of x's numbers: float, double or bfloat16.
template <typename Use>
auto with_real_type(const Tensor& x, const char* name, Use use) {
  STD_TORCH_CHECK(x.is_cpu(), name, ": the tensors must be on the CPU");
  switch (x.scalar_type()) {
    case ScalarType::Float:
      return use.template operator()<float>();
    case ScalarType::Double:
      return use.template operator()<double>();
    default:
      STD_TORCH_CHECK(x.scalar_type() == ScalarType::BFloat16, name,
                      ": the numbers must be float32, float64 or bfloat16");
      return use.template operator()<bfloat16>();
  }
}

}  // namespace darswin

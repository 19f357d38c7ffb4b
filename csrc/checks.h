// The drivers' checks of their arguments. They only keep memory safe; darswin/ops explains wrong
// arguments. `name` is the name of the operator, for messages.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <initializer_list>
#include <optional>
#include <vector>

#include "core/parallel.h"
#include "numbers.h"

namespace darswin {

using torch::headeronly::IntHeaderOnlyArrayRef, torch::headeronly::ScalarType;
using torch::stable::new_zeros;
using torch::stable::Tensor;
using MaybeTensor = std::optional<Tensor>;
using Sizes = std::vector<int64_t>;

// A call through torch's dispatcher costs about 1 µs, as much as a small kernel. The next three
// functions avoid it in the usual case.

// Returns the tensor if it is contiguous, else a contiguous copy.
inline Tensor as_contiguous(const Tensor& tensor) {
  return tensor.is_contiguous() ? tensor : torch::stable::contiguous(tensor);
}
inline MaybeTensor as_contiguous(const MaybeTensor& tensor) {
  return tensor ? MaybeTensor(as_contiguous(*tensor)) : tensor;
}

// Returns a contiguous tensor on the CPU whose values are not initialized, in large pages.
inline Tensor new_tensor(IntHeaderOnlyArrayRef sizes, ScalarType type) {
  Sizes strides(sizes.size(), 1);
  for (size_t axis = sizes.size(); axis > 1; --axis) {
    const int64_t size = std::max<int64_t>(sizes[axis - 1], 1);
    STD_TORCH_CHECK(!__builtin_mul_overflow(strides[axis - 1], size, &strides[axis - 2]),
                    "the sizes are too large");
  }
  AtenTensorHandle made = nullptr;
  TORCH_ERROR_CODE_CHECK(aoti_torch_empty_strided(
      static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(),
      torch::stable::detail::to<int32_t>(torch::stable::detail::from(type)),
      aoti_torch_device_type_cpu(), 0, &made));
  const Tensor tensor(made);
  ask_for_large_pages(tensor.mutable_data_ptr(), tensor.numel() * tensor.element_size());
  return tensor;
}

// Stands for a gradient that is not wanted: an empty tensor.
inline Tensor no_gradient(ScalarType type) { return new_tensor(Sizes{0}, type); }

// The type of tensors whose numbers are T, float or double.
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

// Raises a RuntimeError unless 64 times the product of all positive sizes fits 64 bits. No size is
// negative.
inline void check_product(std::initializer_list<int64_t> sizes) {
  int64_t result = 64;
  for (const int64_t size : sizes) {
    STD_TORCH_CHECK(size == 0 || !__builtin_mul_overflow(result, size, &result),
                    "the sizes are too large");
  }
}

// Returns the number of rows of a tensor, which must have shape (B or 1, sizes...) and type T, and
// be on the CPU. `names` lists the tensors of its kind, for the message.
template <typename T>
int64_t count_rows(const Tensor& tensor, int64_t batch, const Sizes& sizes, const char* names) {
  const Sizes given = tensor.sizes().vec();
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == type_of<T>() &&
                      given.size() == sizes.size() + 1 && (given[0] == 1 || given[0] == batch) &&
                      std::equal(sizes.begin(), sizes.end(), given.begin() + 1),
                  "wrong type, device or shape of ", names);
  return given[0];
}

// Returns the gradient of an output as a contiguous tensor. Gradients may arrive expanded or
// strided: `.sum().backward()` gives stride 0.
inline Tensor checked_gradient(const Tensor& grad, const Sizes& sizes, ScalarType type,
                               const char* name) {
  STD_TORCH_CHECK(grad.is_cpu() && grad.scalar_type() == type && grad.sizes().vec() == sizes, name,
                  "_backward: grad_out must look like the output");
  return as_contiguous(grad);
}

inline Quantizer quantizer(double scale, int64_t zero_point) {
  const double steps = 1 / scale;
  STD_TORCH_CHECK(steps >= 1e-30 && steps <= 1e30 && zero_point >= 0 && zero_point <= 255,
                  "scale must be in 1e-30 ... 1e30, zero_point in 0 ... 255");
  return {static_cast<float>(steps), static_cast<int32_t>(zero_point)};
}

// Returns the gradient of `like`, rounded from doubles that were added in a fixed order.
template <typename T>
Tensor rounded_like(const Tensor& like, const std::vector<double>& sums) {
  const Tensor grad = new_tensor(like.sizes(), type_of<T>());
  std::copy(sums.begin(), sums.end(), mutable_pointer<T>(grad));
  return grad;
}

// Calls use<T>(), where T is the type of x's numbers: float, double or bfloat16.
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

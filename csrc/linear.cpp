// _pack_linear, _norm and _linear on CPU: single layers of optimized models. run.cpp runs whole
// networks.
#include <algorithm>
#include <bit>
#include <cstring>
#include <numeric>
#include <vector>

#include "checks.h"
#include "core/layers.h"

namespace darswin {
namespace {

constexpr char kName[] = "_linear";

void check_parameter(const Tensor& tensor, ScalarType type, int64_t count) {
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == type && tensor.is_contiguous() &&
                      tensor.numel() == count,
                  kName, ": a parameter has a wrong type, layout or number of values");
}

// Packs a weight (D', D) for tokens of type X, in the layout of linear.h. `parameters` has
// kParameters arrays of D' numbers of 32 bits; null stands for zeros. `spare` words follow the
// panels.
template <typename X>
Tensor pack(const Tensor& weight, std::initializer_list<const void*> parameters, int64_t spare) {
  constexpr bool is_float = std::is_same_v<X, float>;
  using Weight = std::conditional_t<is_float, float, int8_t>;
  constexpr int64_t kWord = sizeof(float);
  const int64_t columns = weight.size(0), depth = weight.size(1);
  const int64_t padded = padded_columns(columns), words = depth_words<X>(depth);
  const int64_t count = layer_words<X>(depth, columns) + spare;
  const Tensor packed = new_tensor(Sizes{count}, is_float ? ScalarType::Float : ScalarType::Int);
  auto* to = mutable_pointer<char>(packed);
  std::fill_n(to, count * kWord, 0);
  for (const void* values : parameters) {
    if (values != nullptr) std::memcpy(to, values, columns * kWord);
    to += padded * kWord;
  }
  auto* panels = reinterpret_cast<Weight*>(to);
  const Weight* from = pointer<Weight>(weight);
  for (int64_t column = 0; column < columns; ++column) {
    const int64_t first = column / kPanel * kPanel, width = std::min(kPanel, padded - first);
    for (int64_t k = 0; k < depth; ++k) {
      const int64_t word = first * words + k / kDepths<X> * width + column - first;
      panels[word * kDepths<X> + k % kDepths<X>] = *from++;
    }
  }
  return packed;
}

// With a `weight_scale`, the layer is quantized, and its tokens have this scale and zero point.
Tensor pack_linear(Tensor weight, MaybeTensor bias, MaybeTensor weight_scale, double scale,
                   int64_t zero_point) {
  STD_TORCH_CHECK(weight.is_cpu() && weight.dim() == 2 &&
                      weight.scalar_type() == (weight_scale ? ScalarType::Char : ScalarType::Float),
                  "_pack_linear: weight must be (D', D) of float32 or, with a scale, of int8");
  const int64_t columns = weight.size(0), depth = weight.size(1);
  check_product({columns + kPanelUnit, depth + kParameters<uint8_t> + 1});
  weight = as_contiguous(weight), bias = as_contiguous(bias);
  weight_scale = as_contiguous(weight_scale);
  for (const MaybeTensor& values : {bias, weight_scale}) {
    if (values) check_parameter(*values, ScalarType::Float, columns);
  }
  const void* biases = bias ? bias->const_data_ptr() : nullptr;
  if (!weight_scale) return pack<float>(weight, {biases}, 0);
  const Quantizer tokens = quantizer(scale, zero_point);
  std::vector<int32_t> offsets(columns);  // undo the zero point
  for (int64_t column = 0; column < columns; ++column) {
    const auto* row = pointer<int8_t>(weight) + column * depth;
    const int64_t sum = std::accumulate(row, row + depth, int64_t{0});
    offsets[column] = static_cast<int32_t>(-zero_point * sum);
  }
  const Tensor packed =
      pack<uint8_t>(weight, {biases, weight_scale->const_data_ptr(), offsets.data()}, kLastWords);
  auto* last = mutable_pointer<int32_t>(packed) + layer_words<uint8_t>(depth, columns);
  last[0] = std::bit_cast<int32_t>(static_cast<float>(scale));
  last[1] = std::bit_cast<int32_t>(tokens.steps);
  last[2] = tokens.zero_point;
  return packed;
}

// Returns a packed layer of this depth and these columns.
Layer checked_layer(const Tensor& packed, int64_t depth, int64_t columns) {
  const bool is_quantized = packed.scalar_type() == ScalarType::Int;
  STD_TORCH_CHECK(!is_quantized || depth <= kMostDepth, kName,
                  ": sums of so many products do not fit 32 bits");
  check_parameter(packed, is_quantized ? ScalarType::Int : ScalarType::Float,
                  Layer::words(depth, columns, is_quantized));
  return Layer(packed.const_data_ptr(), depth, columns, is_quantized);
}

// Returns a norm of the parameters (2, D).
Norm checked_norm(const Tensor& parameters, int64_t dim, double eps) {
  check_product({2, dim});
  check_parameter(parameters, ScalarType::Float, 2 * dim);
  return {pointer<float>(parameters), dim, static_cast<float>(eps)};
}

// Checks for tokens (..., D) of a type on the CPU, and returns them contiguous.
Tensor checked_tokens(const Tensor& x, ScalarType type) {
  STD_TORCH_CHECK(x.is_cpu() && x.scalar_type() == type && x.dim() > 0 && x.size(x.dim() - 1) > 0,
                  kName, ": x has a wrong type, or is not (..., D) on the CPU");
  return as_contiguous(x);
}

Tensor norm(Tensor x, Tensor parameters, double eps) {
  x = checked_tokens(x, ScalarType::Float);
  const int64_t dim = x.size(x.dim() - 1);
  const Tensor out = new_tensor(x.sizes(), ScalarType::Float);
  normalize(pointer<float>(x), x.numel() / dim, checked_norm(parameters, dim, eps),
            mutable_pointer<float>(out));
  return out;
}

Tensor linear(Tensor x, Tensor packed, int64_t columns, bool gelu, MaybeTensor norm, double eps) {
  STD_TORCH_CHECK(columns > 0 && x.dim() > 0 && x.size(x.dim() - 1) > 0, kName, ": no columns");
  Sizes sizes = x.sizes().vec();
  const int64_t depth = sizes.back(), rows = x.numel() / depth;
  check_product({depth, columns});
  const Layer layer = checked_layer(packed, depth, columns);
  const ScalarType type = layer.is_quantized ? ScalarType::Byte : ScalarType::Float;
  x = checked_tokens(x, norm ? ScalarType::Float : type);
  if (norm || layer.is_quantized) {
    const Tensor tokens = new_tensor(Sizes{x.numel() + kSpare}, type);
    if (norm) {
      normalize(pointer<float>(x), rows, checked_norm(*norm, depth, eps), tokens.mutable_data_ptr(),
                &layer);
    } else {
      std::copy_n(pointer<uint8_t>(x), x.numel(), mutable_pointer<uint8_t>(tokens));
    }
    x = tokens;
  }
  sizes.back() = columns;
  const Tensor out = new_tensor(sizes, ScalarType::Float);
  multiply(x.const_data_ptr(), rows, layer, out.mutable_data_ptr(),
           gelu ? After::gelu : After::nothing);
  return out;
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("_pack_linear", TORCH_BOX(&darswin::pack_linear));
  m.impl("_norm", TORCH_BOX(&darswin::norm));
  m.impl("_linear", TORCH_BOX(&darswin::linear));
}

// _pack_linear, _norm, _linear and _blocks_ on CPU: the layers and the transformer blocks of
// optimized models.
//
// For a small block, the Python calls take longer than its arithmetic. So all blocks of a stage are
// one operator, which calls kernel after kernel.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <numeric>
#include <vector>

#include "add_norm.h"
#include "linear.h"
#include "window_attention_call.h"

namespace darswin {
namespace {

constexpr char kName[] = "_blocks_";

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

// A packed linear layer. If its words are int32, it is quantized and reads tokens of 8 bits.
struct Layer {
  const Tensor& packed;
  int64_t depth, columns;
  bool is_quantized = packed.scalar_type() == ScalarType::Int;
  float scale = 1;           // of a step of its tokens
  Quantizer quantizer = {};  // of its tokens

  Layer(const Tensor& packed_, int64_t depth_, int64_t columns_)
      : packed(packed_), depth(depth_), columns(columns_) {
    if (!is_quantized) {
      check_parameter(packed, ScalarType::Float, layer_words<float>(depth, columns));
      return;
    }
    STD_TORCH_CHECK(kernels<LinearKernels<uint8_t>>().rows != nullptr && cpu_has_vnni(), kName,
                    ": this tier or this CPU has no products of 8 bits");
    STD_TORCH_CHECK(depth <= kMostDepth, kName, ": sums of so many products do not fit 32 bits");
    const int64_t count = layer_words<uint8_t>(depth, columns);
    check_parameter(packed, ScalarType::Int, count + kLastWords);
    const auto* last = pointer<int32_t>(packed) + count;
    scale = std::bit_cast<float>(last[0]);
    quantizer = {std::bit_cast<float>(last[1]), last[2]};
  }
};

template <typename X>
void multiply(const X* x, int64_t rows, const Layer& layer, void* out, After after,
              const Layer* next) {
  const int64_t depth = layer.depth, columns = layer.columns;
  LinearArgs<X> args{.x = x,
                     .packed = layer.packed.const_data_ptr(),
                     .rows = rows,
                     .depth = depth,
                     .columns = columns,
                     .scale = layer.scale,
                     .after = after};
  if (next != nullptr && next->is_quantized) {
    args.quantized = static_cast<uint8_t*>(out);
    args.quantizer = next->quantizer;
  } else {
    args.out = static_cast<float*>(out);
  }
  const auto& kernel = kernels<LinearKernels<X>>().rows;
  constexpr int64_t kRows = 8;  // ranges begin at a multiple: no tile of rows is cut
  // multiply-adds, on a CPU with AVX2, and on a CPU with VNNI
  constexpr double kPerMicrosecond = std::is_same_v<X, float> ? 5e4 : 1e5;
  const double work = static_cast<double>(rows) * depth * columns;
  const int64_t threads = threads_for(work / kPerMicrosecond);
  const int64_t tiles = units(rows, kRows), panels = panel_count(columns);
  if (panels < threads || tiles >= 16 * threads) {
    parallel_ranges(tiles, threads, [&](int64_t begin, int64_t end) {
      kernel(args, begin * kRows, std::min(end * kRows, rows), 0, panels);
    });
  } else {
    parallel_ranges(panels, threads,
                    [&](int64_t begin, int64_t end) { kernel(args, 0, rows, begin, end); });
  }
}

// Writes the linear layer of x to `out`, or its GELU, or adds it to `out`. The numbers of x are
// what the layer reads, and the result is what `next` reads; without `next`, it is float. The
// threads share the rows of a long map, or the columns of the result of a short map.
void multiply(const void* x, int64_t rows, const Layer& layer, void* out,
              After after = After::nothing, const Layer* next = nullptr) {
  if (layer.is_quantized) {
    multiply(static_cast<const uint8_t*>(x), rows, layer, out, after, next);
  } else {
    multiply(static_cast<const float*>(x), rows, layer, out, after, next);
  }
}

template <typename Out>
void normalize(const float* x, int64_t rows, int64_t dim, const Tensor& parameters, double eps,
               Out* out, Quantizer quantizer = {}) {
  check_parameter(parameters, ScalarType::Float, 2 * dim);
  // Without a second summand, the kernel only reads x.
  AddNormArgs<float, Out> args{.x = const_cast<float*>(x),
                               .out = out,
                               .weight = pointer<float>(parameters),
                               .eps = static_cast<float>(eps),
                               .width = dim,
                               .quantizer = quantizer};
  args.bias = args.weight + dim;
  constexpr double kPerMicrosecond = 4000;  // numbers
  const int64_t threads = threads_for(static_cast<double>(rows) * dim / kPerMicrosecond);
  parallel_ranges(rows, threads, [&](int64_t begin, int64_t end) {
    kernels<AddNormKernels<float, Out>>().rows(args, begin, end);
  });
}

// Writes the layer norm of the rows of x to `out`, as the layer `next` reads it. `parameters` is
// the norm's weight and its bias, (2, D).
void normalize(const float* x, int64_t rows, const Tensor& parameters, double eps, void* out,
               const Layer& next) {
  if (next.is_quantized) {
    normalize(x, rows, next.depth, parameters, eps, static_cast<uint8_t*>(out), next.quantizer);
  } else {
    normalize(x, rows, next.depth, parameters, eps, static_cast<float*>(out));
  }
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
  normalize(pointer<float>(x), x.numel() / dim, dim, parameters, eps, mutable_pointer<float>(out));
  return out;
}

Tensor linear(Tensor x, Tensor packed, int64_t columns, bool gelu, MaybeTensor norm, double eps) {
  STD_TORCH_CHECK(columns > 0 && x.dim() > 0 && x.size(x.dim() - 1) > 0, kName, ": no columns");
  Sizes sizes = x.sizes().vec();
  const int64_t depth = sizes.back(), rows = x.numel() / depth;
  check_product({depth, columns});
  const Layer layer(packed, depth, columns);
  const ScalarType type = layer.is_quantized ? ScalarType::Byte : ScalarType::Float;
  x = checked_tokens(x, norm ? ScalarType::Float : type);
  if (norm || layer.is_quantized) {
    const Tensor tokens = new_tensor(Sizes{x.numel() + kSpare}, type);
    if (norm) {
      normalize(pointer<float>(x), rows, *norm, eps, tokens.mutable_data_ptr(), layer);
    } else {
      std::copy_n(pointer<uint8_t>(x), x.numel(), mutable_pointer<uint8_t>(tokens));
    }
    x = tokens;
  }
  sizes.back() = columns;
  const Tensor out = new_tensor(sizes, ScalarType::Float);
  ask_for_large_pages(out);
  multiply(x.const_data_ptr(), rows, layer, out.mutable_data_ptr(),
           gelu ? After::gelu : After::nothing);
  return out;
}

// The blocks of a stage. They change the residual x in place. The tokens between two layers are
// float, or have 8 bits in the same memory.
struct Blocks {
  int64_t heads, mlp_dim;
  double eps;
  Tensor x;
  int64_t dim = x.size(3), rows = x.numel() / dim;
  Tensor normed = new_tensor(x.sizes(), ScalarType::Float),
         hidden = new_tensor(Sizes{rows, mlp_dim}, ScalarType::Float);
  Tensor qkv =
      new_tensor(Sizes{x.size(0), x.size(1), x.size(2), 3, heads, dim / heads}, ScalarType::Float);

  // Runs one block, given its six parameters, and the window, the shift and the periodic axes of
  // its attention.
  void block(const Tensor* parameters, const Tensor& table, const int64_t* windows) {
    const Layer to_qkv(parameters[1], dim, 3 * dim), proj(parameters[2], dim, dim);
    const Layer fc1(parameters[4], dim, mlp_dim), fc2(parameters[5], mlp_dim, dim);
    auto* residual = mutable_pointer<float>(x);
    void *tokens = normed.mutable_data_ptr(), *hidden_tokens = hidden.mutable_data_ptr();
    normalize(residual, rows, parameters[0], eps, tokens, to_qkv);
    multiply(tokens, rows, to_qkv, qkv.mutable_data_ptr());
    attend(table, windows, proj);
    multiply(tokens, rows, proj, residual, After::add);
    normalize(residual, rows, parameters[3], eps, tokens, fc1);
    multiply(tokens, rows, fc1, hidden_tokens, After::gelu, &fc2);
    multiply(hidden_tokens, rows, fc2, residual, After::add);
  }

  // Reads `qkv` and writes `normed`, as the layer `next` reads it.
  void attend(const Tensor& table, const int64_t* windows, const Layer& next) {
    const auto pair = [&](int k) { return Sizes(windows + k, windows + k + 2); };
    const double scale = 1 / std::sqrt(static_cast<double>(dim / heads));
    AttentionCall<float> call(qkv, table, pair(0), pair(2), pair(4), scale);
    if (next.is_quantized) {
      call.args.quantized = mutable_pointer<uint8_t>(normed);
      call.args.quantizer = next.quantizer;
    } else {
      call.args.out = mutable_pointer<float>(normed);
    }
    call.run(call.args.windows * heads, 2, kernels<WindowAttentionKernels<float>>().forward);
  }
};

void blocks_(Tensor x, std::vector<Tensor> parameters, std::vector<Tensor> tables, Sizes windows,
             int64_t heads, int64_t mlp_dim, double eps) {
  const size_t count = tables.size();
  STD_TORCH_CHECK(x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() == 4 &&
                      x.is_contiguous() && heads > 0 && x.size(3) > 0 && x.size(3) % heads == 0 &&
                      mlp_dim > 0 && parameters.size() == 6 * count && windows.size() == 6 * count,
                  kName, ": wrong arguments");
  if (x.numel() == 0) return;
  check_product({x.size(3), mlp_dim});
  check_product({x.numel() / x.size(3), mlp_dim});
  Blocks blocks{heads, mlp_dim, eps, x};
  for (size_t k = 0; k < count; ++k) {
    blocks.block(&parameters[6 * k], tables[k], &windows[6 * k]);
  }
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("_pack_linear", TORCH_BOX(&darswin::pack_linear));
  m.impl("_norm", TORCH_BOX(&darswin::norm));
  m.impl("_linear", TORCH_BOX(&darswin::linear));
  m.impl("_blocks_", TORCH_BOX(&darswin::blocks_));
}

// _norm, _linear and _blocks_ on CPU: the layers and the transformer blocks of optimized models.
//
// For a small block, the Python calls take longer than its arithmetic. So all blocks of a stage are
// one operator, which calls kernel after kernel.
#include <algorithm>
#include <cmath>
#include <vector>

#include "add_norm.h"
#include "linear.h"
#include "window_attention_call.h"

namespace darswin {
namespace {

constexpr char kName[] = "_blocks_";

const float* floats(const Tensor& tensor, int64_t count) {
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == ScalarType::Float &&
                      tensor.is_contiguous() && tensor.numel() == count,
                  kName, ": a parameter has a wrong type, layout or number of values");
  return pointer<float>(tensor);
}

// Writes the linear layer of x to `out`, or its GELU, or adds it to `out`. The threads share the
// rows of a long map, or the columns of the result of a short map.
void multiply(const float* x, int64_t rows, int64_t depth, const Tensor& packed, int64_t columns,
              float* out, After after = After::nothing) {
  LinearArgs args{x, nullptr, out, rows, depth, columns, after};
  args.packed = floats(packed, packed_size(args));
  const auto& kernel = kernels<LinearKernels>().rows;
  constexpr int64_t kRows = 8;             // ranges begin at a multiple: no tile of rows is cut
  constexpr double kPerMicrosecond = 5e4;  // multiply-adds, on a CPU with AVX2
  const double work = static_cast<double>(rows) * depth * columns;
  const int64_t threads = threads_for(work / kPerMicrosecond);
  const int64_t tiles = (rows + kRows - 1) / kRows, panels = panel_count(args);
  if (panels < threads || tiles >= 16 * threads) {
    parallel_ranges(tiles, threads, [&](int64_t begin, int64_t end) {
      kernel(args, begin * kRows, std::min(end * kRows, rows), 0, panels);
    });
  } else {
    parallel_ranges(panels, threads,
                    [&](int64_t begin, int64_t end) { kernel(args, 0, rows, begin, end); });
  }
}

// Writes the layer norm of the rows of x to `out`. `parameters` is its weight and its bias, (2, D).
void normalize(const float* x, int64_t rows, int64_t dim, const Tensor& parameters, double eps,
               float* out) {
  // Without a second summand, the kernel only reads x.
  AddNormArgs<float, float> args{.x = const_cast<float*>(x),
                                 .out = out,
                                 .weight = floats(parameters, 2 * dim),
                                 .eps = static_cast<float>(eps),
                                 .width = dim};
  args.bias = args.weight + dim;
  constexpr double kPerMicrosecond = 4000;  // numbers
  const int64_t threads = threads_for(static_cast<double>(rows) * dim / kPerMicrosecond);
  parallel_ranges(rows, threads, [&](int64_t begin, int64_t end) {
    kernels<AddNormKernels<float, float>>().rows(args, begin, end);
  });
}

// Checks for float32 (..., D) on the CPU, and returns it contiguous.
Tensor checked_tokens(const Tensor& x) {
  STD_TORCH_CHECK(
      x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() > 0 && x.size(x.dim() - 1) > 0,
      kName, ": x must be float32 (..., D) on the CPU");
  return as_contiguous(x);
}

Tensor norm(Tensor x, Tensor parameters, double eps) {
  x = checked_tokens(x);
  const int64_t dim = x.size(x.dim() - 1);
  const Tensor out = new_tensor(x.sizes(), ScalarType::Float);
  normalize(pointer<float>(x), x.numel() / dim, dim, parameters, eps, mutable_pointer<float>(out));
  return out;
}

Tensor linear(Tensor x, Tensor packed, int64_t columns, bool gelu, MaybeTensor norm, double eps) {
  x = checked_tokens(x);
  STD_TORCH_CHECK(columns > 0, kName, ": no columns");
  Sizes sizes = x.sizes().vec();
  const int64_t depth = sizes.back(), rows = x.numel() / depth;
  check_product({depth, columns});
  if (norm) {
    const Tensor normed = new_tensor(x.sizes(), ScalarType::Float);
    normalize(pointer<float>(x), rows, depth, *norm, eps, mutable_pointer<float>(normed));
    x = normed;
  }
  sizes.back() = columns;
  const Tensor out = new_tensor(sizes, ScalarType::Float);
  ask_for_large_pages(out);
  multiply(pointer<float>(x), rows, depth, packed, columns, mutable_pointer<float>(out),
           gelu ? After::gelu : After::nothing);
  return out;
}

// The blocks of a stage. They change the residual x in place.
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
    const auto *tokens = pointer<float>(normed), *hidden_tokens = pointer<float>(hidden);
    auto* residual = mutable_pointer<float>(x);
    auto* to = mutable_pointer<float>(normed);
    normalize(residual, rows, dim, parameters[0], eps, to);
    multiply(tokens, rows, dim, parameters[1], 3 * dim, mutable_pointer<float>(qkv));
    attend(table, windows);
    multiply(tokens, rows, dim, parameters[2], dim, residual, After::add);
    normalize(residual, rows, dim, parameters[3], eps, to);
    multiply(tokens, rows, dim, parameters[4], mlp_dim, mutable_pointer<float>(hidden),
             After::gelu);
    multiply(hidden_tokens, rows, mlp_dim, parameters[5], dim, residual, After::add);
  }

  // Reads `qkv` and writes `normed`.
  void attend(const Tensor& table, const int64_t* windows) {
    const auto pair = [&](int k) { return Sizes(windows + k, windows + k + 2); };
    const double scale = 1 / std::sqrt(static_cast<double>(dim / heads));
    AttentionCall<float> call(qkv, table, pair(0), pair(2), pair(4), scale);
    call.args.out = mutable_pointer<float>(normed);
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
  m.impl("_norm", TORCH_BOX(&darswin::norm));
  m.impl("_linear", TORCH_BOX(&darswin::linear));
  m.impl("_blocks_", TORCH_BOX(&darswin::blocks_));
}

// linear, mlp and their backward on CPU: the linear layers of models in training.
//
// The weights change in every step, so each call packs them, for the kernels of optimized models.
// Long maps are computed in parts that stay in the third-level cache. For its backward an MLP keeps
// the input of the GELU, and nothing else that is as wide.
//
// Torch's own operators come before and after, so all of these use its threads.
#include <algorithm>
#include <tuple>
#include <utility>

#include "checks.h"
#include "core/dispatch.h"
#include "core/layers.h"
#include "elements.h"

namespace darswin {
namespace {

constexpr double kPerMicrosecond = 5e4;  // multiply-adds
constexpr int64_t kChunk = 512;          // rows of which a sum is taken at once
constexpr int64_t kPart = 1 << 19;       // numbers that stay in the third-level cache

// Checks for a float32 tensor on the CPU, and returns it contiguous.
Tensor checked(const Tensor& tensor, const char* name) {
  STD_TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == ScalarType::Float, name,
                  ": the tensors must be float32 on the CPU");
  return as_contiguous(tensor);
}

// A layer: its weight (columns, depth) and its bias (columns,), which may be missing.
struct Weights {
  Tensor weight;
  MaybeTensor bias;
  int64_t columns, depth;

  Weights(const Tensor& weight_, const MaybeTensor& bias_, int64_t depth_, const char* name)
      : weight(checked(weight_, name)), bias(bias_), depth(depth_) {
    if (bias) bias = checked(*bias, name);
    STD_TORCH_CHECK(weight.dim() == 2 && weight.size(1) == depth && weight.numel() > 0, name,
                    ": a weight must be (D', D) for x (..., D)");
    columns = weight.size(0);
    STD_TORCH_CHECK(!bias || (bias->dim() == 1 && bias->size(0) == columns), name,
                    ": a bias must be (D',)");
    check_product({depth + kPanelUnit, columns + kPanelUnit});
  }

  // The layer, and without its bias the layer of the transposed weight.
  Tensor packed() const {
    const Tensor layer = new_layer(depth, columns);
    auto* const to = mutable_pointer<float>(layer);
    if (bias) std::copy_n(pointer<float>(*bias), columns, to);
    parallel_ranges(panel_count(columns), pack_threads(), [&](int64_t begin, int64_t end) {
      kernels<LinearKernels<float>>().pack(pointer<float>(weight), columns, depth, begin, end, to);
    });
    return layer;
  }
  Tensor transposed() const {
    const Tensor layer = new_layer(columns, depth);
    auto* const to = mutable_pointer<float>(layer) + padded_columns(depth);
    parallel_ranges(panel_count(depth), pack_threads(), [&](int64_t begin, int64_t end) {
      for (int64_t n = begin * kPanel; n < std::min(end * kPanel, depth); n += kPanel) {
        kernels<LinearKernels<float>>().pack_rows(pointer<float>(weight) + n, depth, columns,
                                                  std::min(kPanel, depth - n), to + n * columns);
      }
    });
    return layer;
  }

 private:
  static Tensor new_layer(int64_t depth, int64_t columns) {
    const Tensor layer = new_tensor(Sizes{layer_words<float>(depth, columns)}, ScalarType::Float);
    std::fill_n(mutable_pointer<float>(layer), padded_columns(columns), 0.0f);
    return layer;
  }
  Threads pack_threads() const { return threads_for(static_cast<double>(depth) * columns / 1e3); }
};

// out = x * the packed layer
void multiply_by(const Tensor& packed, const float* x, int64_t rows, int64_t depth, int64_t columns,
                 float* out) {
  multiply(x, rows, Layer(packed.const_data_ptr(), depth, columns, false), out);
}

// The rows of a part whose numbers, so many in each row, stay in the third-level cache.
int64_t rows_of_part(int64_t floats) { return round_up(units(kPart, floats), kChunk); }

// Memory for the numbers of a part.
Tensor part_of(int64_t rows, int64_t floats) {
  return new_tensor(Sizes{std::min(rows, rows_of_part(floats)), floats}, ScalarType::Float);
}

// Calls body(first, count) for parts of the rows, whose numbers stay in the third-level cache.
template <typename Body>
void for_parts(int64_t rows, int64_t floats, Body body) {
  const int64_t part = rows_of_part(floats);
  for (int64_t first = 0; first < rows; first += part) body(first, std::min(part, rows - first));
}

// Writes or adds the gradients of a layer: sums over the rows. grad_bias may be null. The rows are
// cut into groups, whose number does not depend on the threads, and the sums of the groups are
// added in their order. A thread computes the columns of some panels for one group.
void derive_layer(const float* x, const float* grad_out, int64_t rows, const Weights& layer,
                  bool adds, float* grad_weight, float* grad_bias) {
  constexpr int64_t kItems = 16;
  const int64_t depth = layer.depth, columns = layer.columns, panels = panel_count(depth);
  const int64_t groups = std::min(units(kItems, panels), std::max<int64_t>(rows / kChunk, 1));
  const int64_t size = columns * depth, both = size + columns;
  const Tensor rest = new_tensor(Sizes{groups - 1, both}, ScalarType::Float);
  const auto sums = [&](int64_t group) {
    if (group == 0) return std::pair(grad_weight, grad_bias);
    auto* const weight = mutable_pointer<float>(rest) + (group - 1) * both;
    return std::pair(weight, weight + size);
  };
  const auto& elements = kernels<ElementKernels>();
  const auto& products = kernels<LinearKernels<float>>();
  const auto add_up = [&](int64_t begin, int64_t end, void* scratch) {
    auto* const packed = static_cast<float*>(scratch);
    for (int64_t item = begin, next; item < end; item = next) {
      const int64_t group = item / panels, last = rows * (group + 1) / groups;
      next = std::min(end, (group + 1) * panels);
      const auto [weight, bias] = sums(group);
      After after = adds && group == 0 ? After::add : After::nothing;
      const bool adds_bias = item % panels == 0 && grad_bias != nullptr;
      if (adds_bias && after == After::nothing) std::fill_n(bias, columns, 0.0f);
      for (int64_t row = rows * group / groups; row < last; row += kChunk) {
        const int64_t count = std::min(kChunk, last - row);
        const float* const grad = grad_out + row * columns;
        for (int64_t panel = item; panel < next; ++panel) {
          const int64_t column = panel % panels * kPanel, width = std::min(kPanel, depth - column);
          std::fill_n(packed, padded_columns(width), 0.0f);
          products.pack_rows(x + row * depth + column, depth, count, width,
                             packed + padded_columns(width));
          const LinearArgs<float> args{.x = grad,
                                       .packed = packed,
                                       .rows = columns,
                                       .depth = count,
                                       .columns = width,
                                       .stride = 1,
                                       .step = columns,
                                       .after = after,
                                       .out = weight + column,
                                       .out_stride = depth};
          products.rows(args, 0, columns, 0, 1);
        }
        if (adds_bias) elements.add_rows(grad, count, columns, bias);
        after = After::add;
      }
    }
  };
  const int64_t floats = kPanel + kChunk * kPanel;
  const Threads threads = threads_for(static_cast<double>(rows) * size / kPerMicrosecond);
  run_with_scratch(panels * groups, threads, floats * sizeof(float), add_up);
  for (int64_t group = 1; group < groups; ++group) {
    const auto [weight, bias] = sums(group);
    elements.add(weight, grad_weight, size);
    if (grad_bias != nullptr) elements.add(bias, grad_bias, columns);
  }
}

// A gradient like a tensor, which is zero without rows, or none.
Tensor new_gradient(bool wanted, const MaybeTensor& like, int64_t rows) {
  if (!wanted || !like) return no_gradient(ScalarType::Float);
  const Tensor grad = new_tensor(like->sizes(), ScalarType::Float);
  if (rows == 0) std::fill_n(mutable_pointer<float>(grad), grad.numel(), 0.0f);
  return grad;
}

// -- one layer -----------------------------------------------------------------------------------

constexpr char kLinear[] = "linear";

// The tokens x (rows, D) of a call.
struct Tokens {
  Tensor x;
  int64_t dim, rows;
  Tokens(const Tensor& x_, const char* name) : x(checked(x_, name)) {
    STD_TORCH_CHECK(x.dim() > 0 && x.size(x.dim() - 1) > 0, name, ": x must be (..., D)");
    dim = x.size(x.dim() - 1), rows = x.numel() / dim;
  }
  Sizes sizes(int64_t columns) const {
    Sizes sizes = x.sizes().vec();
    sizes.back() = columns;
    return sizes;
  }
};

Tensor linear(Tensor x, Tensor weight, MaybeTensor bias) {
  const TorchThreads in_training;
  const Tokens tokens(x, kLinear);
  const Weights layer(weight, bias, tokens.dim, kLinear);
  const Tensor out = new_tensor(tokens.sizes(layer.columns), ScalarType::Float);
  multiply_by(layer.packed(), pointer<float>(tokens.x), tokens.rows, layer.depth, layer.columns,
              mutable_pointer<float>(out));
  return out;
}

std::tuple<Tensor, Tensor, Tensor> linear_backward(Tensor x, Tensor weight, MaybeTensor bias,
                                                   Tensor grad_out, bool x_grad, bool weight_grad,
                                                   bool bias_grad) {
  const TorchThreads in_training;
  const Tokens tokens(x, kLinear);
  const Weights layer(weight, bias, tokens.dim, kLinear);
  const int64_t depth = layer.depth, columns = layer.columns, rows = tokens.rows;
  grad_out = checked_gradient(grad_out, tokens.sizes(columns), ScalarType::Float, kLinear);
  const Tensor grad_x = new_gradient(x_grad, x, rows);
  const Tensor grad_weight = new_gradient(weight_grad || bias_grad, weight, rows);
  const Tensor grad_bias = new_gradient(bias_grad, bias, rows);
  const MaybeTensor back = x_grad ? MaybeTensor(layer.transposed()) : std::nullopt;
  for_parts(rows, depth + columns, [&](int64_t begin, int64_t count) {
    const auto* const grad = pointer<float>(grad_out) + begin * columns;
    if (back) {
      multiply_by(*back, grad, count, columns, depth,
                  mutable_pointer<float>(grad_x) + begin * depth);
    }
    if (weight_grad || bias_grad) {
      derive_layer(pointer<float>(tokens.x) + begin * depth, grad, count, layer, begin > 0,
                   mutable_pointer<float>(grad_weight),
                   grad_bias.numel() > 0 ? mutable_pointer<float>(grad_bias) : nullptr);
    }
  });
  return {grad_x, weight_grad ? grad_weight : no_gradient(ScalarType::Float), grad_bias};
}

// -- linear, GELU, linear ------------------------------------------------------------------------

constexpr char kMlp[] = "mlp";

// Calls body(k, n) for ranges of `count` numbers that the GELU replaces.
template <typename Body>
void for_numbers(int64_t count, Body body) {
  constexpr double kNumbersPerMicrosecond = 1500;
  parallel_ranges(count, threads_for(static_cast<double>(count) / kNumbersPerMicrosecond),
                  [&](int64_t begin, int64_t end) { body(begin, end - begin); });
}

std::tuple<Tensor, Tensor> mlp(Tensor x, Tensor weight1, Tensor bias1, Tensor weight2,
                               Tensor bias2) {
  const TorchThreads in_training;
  const Tokens tokens(x, kMlp);
  const Weights first(weight1, bias1, tokens.dim, kMlp);
  const Weights second(weight2, bias2, first.columns, kMlp);
  const int64_t depth = first.depth, width = first.columns, columns = second.columns;
  const Tensor out = new_tensor(tokens.sizes(columns), ScalarType::Float);
  const Tensor hidden = new_tensor(tokens.sizes(width), ScalarType::Float);
  const Tensor packed1 = first.packed(), packed2 = second.packed();
  const Tensor scratch = part_of(tokens.rows, width);
  auto* const activated = mutable_pointer<float>(scratch);
  for_parts(tokens.rows, width, [&](int64_t begin, int64_t count) {
    float* const h = mutable_pointer<float>(hidden) + begin * width;
    multiply_by(packed1, pointer<float>(tokens.x) + begin * depth, count, depth, width, h);
    for_numbers(count * width, [&](int64_t k, int64_t n) {
      std::copy_n(h + k, n, activated + k);
      kernels<ElementKernels>().gelu(activated + k, n);
    });
    multiply_by(packed2, activated, count, width, columns,
                mutable_pointer<float>(out) + begin * columns);
  });
  return {out, hidden};
}

// All gradients are computed, because in training all are wanted.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> mlp_backward(Tensor x, Tensor weight1,
                                                                Tensor bias1, Tensor weight2,
                                                                Tensor bias2, Tensor hidden,
                                                                Tensor grad_out) {
  const TorchThreads in_training;
  const Tokens tokens(x, kMlp);
  const Weights first(weight1, bias1, tokens.dim, kMlp);
  const Weights second(weight2, bias2, first.columns, kMlp);
  const int64_t depth = first.depth, width = first.columns, columns = second.columns;
  const int64_t rows = tokens.rows;
  hidden = checked_gradient(hidden, tokens.sizes(width), ScalarType::Float, kMlp);
  grad_out = checked_gradient(grad_out, tokens.sizes(columns), ScalarType::Float, kMlp);
  const auto grads = [&](const Tensor& like) { return new_gradient(true, like, rows); };
  const Tensor grad_x = grads(x), grad_weight1 = grads(weight1), grad_bias1 = grads(bias1),
               grad_weight2 = grads(weight2), grad_bias2 = grads(bias2);
  const Tensor back1 = first.transposed(), back2 = second.transposed();
  const Tensor scratch1 = part_of(rows, width), scratch2 = part_of(rows, width);
  auto *const activated = mutable_pointer<float>(scratch1), *const derived =
                                                                mutable_pointer<float>(scratch2);
  for_parts(rows, width, [&](int64_t begin, int64_t count) {
    const float* const h = pointer<float>(hidden) + begin * width;
    const float* const grad = pointer<float>(grad_out) + begin * columns;
    multiply_by(back2, grad, count, columns, width, derived);
    for_numbers(count * width, [&](int64_t k, int64_t n) {
      std::copy_n(h + k, n, activated + k);
      kernels<ElementKernels>().derive_gelu(activated + k, derived + k, n);
    });
    multiply_by(back1, derived, count, width, depth,
                mutable_pointer<float>(grad_x) + begin * depth);
    derive_layer(activated, grad, count, second, begin > 0, mutable_pointer<float>(grad_weight2),
                 mutable_pointer<float>(grad_bias2));
    derive_layer(pointer<float>(tokens.x) + begin * depth, derived, count, first, begin > 0,
                 mutable_pointer<float>(grad_weight1), mutable_pointer<float>(grad_bias1));
  });
  return {grad_x, grad_weight1, grad_bias1, grad_weight2, grad_bias2};
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("linear", TORCH_BOX(&darswin::linear));
  m.impl("linear_backward", TORCH_BOX(&darswin::linear_backward));
  m.impl("mlp", TORCH_BOX(&darswin::mlp));
  m.impl("mlp_backward", TORCH_BOX(&darswin::mlp_backward));
}

#include "layers.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "attention.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

// AMX takes longer than products of four bytes where the depth does not fill a tile: darswin_a_nano
// took 0.281 ms with AMX for all its products, 0.263 ms without, and 0.261 ms with this limit. All
// deeper products of 16 rows or more are faster, from 64 x 96 x 96 (9 and 11 us) on.
constexpr int64_t kTileDepth = 64;

template <typename X>
void multiply_tokens(const X* x, int64_t rows, const Layer& layer, void* out, After after,
                     const Layer* next) {
  const int64_t depth = layer.depth, columns = layer.columns;
  LinearArgs<X> args{.x = x,
                     .packed = layer.packed,
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
  constexpr int64_t kRows = 16;  // ranges begin at a multiple: no tile of rows is cut
  const auto& table = kernels<LinearKernels<X>>();
  auto kernel = table.rows;
  double per_microsecond = 5e4;  // multiply-adds
  if constexpr (std::is_same_v<X, uint8_t>) {
    const ByteProducts best = byte_products();
    if (best == ByteProducts::tiles && rows >= kRows && depth >= kTileDepth) {
      kernel = table.by_tiles, per_microsecond = 4e5;
    } else if (best != ByteProducts::pairs && table.by_fours != nullptr) {
      kernel = table.by_fours, per_microsecond = 1e5;
    }
  }
  const double work = static_cast<double>(rows) * depth * columns;
  const Threads threads = threads_for(work / per_microsecond);
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

template <typename Out>
void normalize_rows(const float* x, int64_t rows, const Norm& norm, Out* out, Quantizer quantizer) {
  const NormArgs<Out> args{.x = x,
                           .out = out,
                           .weight = norm.parameters,
                           .bias = norm.parameters + norm.dim,
                           .eps = norm.eps,
                           .width = norm.dim,
                           .quantizer = quantizer};
  constexpr double kPerMicrosecond = 4000;  // numbers
  const Threads threads = threads_for(static_cast<double>(rows) * norm.dim / kPerMicrosecond);
  parallel_ranges(rows, threads, [&](int64_t begin, int64_t end) {
    kernels<NormKernels<Out>>().rows(args, begin, end);
  });
}

}  // namespace

int64_t Layer::words(int64_t depth, int64_t columns, bool is_quantized) {
  return is_quantized ? layer_words<uint8_t>(depth, columns) + kLastWords
                      : layer_words<float>(depth, columns);
}

Layer::Layer(const void* packed_, int64_t depth_, int64_t columns_, bool is_quantized_)
    : packed(packed_), depth(depth_), columns(columns_), is_quantized(is_quantized_) {
  if (!is_quantized) return;
  const auto* last = static_cast<const int32_t*>(packed) + words(depth, columns, true) - kLastWords;
  scale = std::bit_cast<float>(last[0]);
  quantizer = {std::bit_cast<float>(last[1]), last[2]};
}

void multiply(const void* x, int64_t rows, const Layer& layer, void* out, After after,
              const Layer* next) {
  if (layer.is_quantized) {
    multiply_tokens(static_cast<const uint8_t*>(x), rows, layer, out, after, next);
  } else {
    multiply_tokens(static_cast<const float*>(x), rows, layer, out, after, next);
  }
}

void normalize(const float* x, int64_t rows, const Norm& norm, void* out, const Layer* next) {
  if (next != nullptr && next->is_quantized) {
    normalize_rows(x, rows, norm, static_cast<uint8_t*>(out), next->quantizer);
  } else {
    normalize_rows(x, rows, norm, static_cast<float*>(out), Quantizer{});
  }
}

void attend(WindowAttentionArgs<float> args, void* out, const Layer& next) {
  if (next.is_quantized) {
    args.quantized = static_cast<uint8_t*>(out);
    args.quantizer = next.quantizer;
  } else {
    args.out = static_cast<float*>(out);
  }
  run_attention(args, args.windows * args.heads, 2,
                kernels<WindowAttentionKernels<float>>().forward);
}

namespace {

// The parts of a block's working memory.
struct Parts {
  int64_t normed, qkv, hidden;  // bytes
  Parts(const Block& block, int64_t tokens) {
    const auto floats = [&](int64_t width) {
      return round_up(tokens * width * sizeof(float) + kSpare, 64);
    };
    normed = floats(block.norm1.dim), qkv = floats(block.qkv.columns);
    hidden = floats(block.fc1.columns);
  }
};

}  // namespace

int64_t Block::scratch(int64_t tokens) const {
  const Parts parts(*this, tokens);
  return parts.normed + parts.qkv + parts.hidden;
}

void Block::run(float* x, int64_t batch, const float* table, int64_t table_rows,
                void* scratch) const {
  const int64_t rows = batch * windows.rings * windows.sectors;
  const Parts parts(*this, rows);
  auto* normed = static_cast<char*>(scratch);
  char *keys = normed + parts.normed, *hidden = keys + parts.qkv;
  normalize(x, rows, norm1, normed, &qkv);
  multiply(normed, rows, qkv, keys);
  WindowAttentionArgs<float> args = windows;
  args.qkv = reinterpret_cast<const float*>(keys);
  args.bias = table, args.bias_rows = table_rows;
  args.windows *= batch;
  attend(args, normed, proj);
  multiply(normed, rows, proj, x, After::add);
  normalize(x, rows, norm2, normed, &fc1);
  multiply(normed, rows, fc1, hidden, After::gelu, &fc2);
  multiply(hidden, rows, fc2, x, After::add);
}

}  // namespace darswin

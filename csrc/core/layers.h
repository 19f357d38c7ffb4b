// Layers and transformer blocks on packed weights: which kernels run, and on how many threads.
// Nothing here uses torch. Nothing is checked: the callers keep memory safe.
#pragma once

#include "../linear.h"
#include "../norm.h"
#include "../window_attention.h"

namespace darswin {

// A packed linear layer (see linear.h). If it is quantized, it reads tokens of 8 bits.
struct Layer {
  const void* packed = nullptr;
  int64_t depth = 0, columns = 0;
  bool is_quantized = false;
  float scale = 1;           // of a step of its tokens
  Quantizer quantizer = {};  // of its tokens

  Layer() = default;
  // The layer whose words are at `packed`.
  Layer(const void* packed, int64_t depth, int64_t columns, bool is_quantized);

  // The number of words of 32 bits of a layer.
  static int64_t words(int64_t depth, int64_t columns, bool is_quantized);
};

// A layer norm: its weight, then its bias, of `dim` numbers each.
struct Norm {
  const float* parameters = nullptr;
  int64_t dim = 0;
  float eps = 0;
};

// Writes the linear layer of x to `out`, or its GELU, or adds it to `out`. The numbers of x are
// what the layer reads, and the result is what `next` reads; without `next`, it is float. The
// threads share the rows of a long map, or the columns of the result of a short map.
void multiply(const void* x, int64_t rows, const Layer& layer, void* out,
              After after = After::nothing, const Layer* next = nullptr);

// Writes the layer norm of the rows of x to `out`, as the layer `next` reads it; without `next`, it
// is float.
void normalize(const float* x, int64_t rows, const Norm& norm, void* out,
               const Layer* next = nullptr);

// Runs window attention; its result is what the layer `next` reads.
void attend(WindowAttentionArgs<float> args, void* out, const Layer& next);

// A transformer block on maps (batch, R, A, D). It changes the maps in place.
struct Block {
  Norm norm1, norm2;
  Layer qkv, proj, fc1, fc2;
  WindowAttentionArgs<float> windows{};  // of one image, without pointers

  // The bytes of working memory for so many tokens.
  int64_t scratch(int64_t tokens) const;
  // `table` is the position bias (table_rows, heads, 2 M_r - 1, 2 M_a - 1), with a row for each
  // image or one for all.
  void run(float* x, int64_t batch, const float* table, int64_t table_rows, void* scratch) const;
};

}  // namespace darswin

// The interface between the driver of linear layers and its kernels.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// A packed linear layer is one array of words of 32 bits. First come the parameters of the columns,
// then the weight in panels of kPanel columns. Each panel is a matrix (words of the depth, columns
// of the panel). The last panel has the remaining columns. The columns are padded with zeros to a
// multiple of kPanelUnit.
//
// X is the type of the tokens. If X is float, a word is one float, and the only parameter of a
// column is its bias. If X is uint8_t, a word holds the weights of four depths as signed 8 bits.
// The parameters are then the bias, the size of a step of the weights, and the int32 that is added
// to the sum to undo the zero point of the tokens. kLastWords words follow the panels: the size of
// a step of the tokens, and their Quantizer. The operator _pack_linear packs layers.
constexpr int64_t kPanel = 48, kPanelUnit = 16, kLastWords = 3;
// Kernels read whole words, so they may read this many bytes beyond the last token.
constexpr int64_t kSpare = 3;
// The greatest depth of 8 bits: no sum overflows.
constexpr int64_t kMostDepth = 1 << 16;

namespace {

template <typename X>
constexpr int64_t kDepths = sizeof(float) / sizeof(X);  // of a word
template <typename X>
constexpr int64_t kParameters = std::is_same_v<X, float> ? 1 : 3;  // of a column

inline int64_t padded_columns(int64_t columns) { return round_up(columns, kPanelUnit); }
inline int64_t panel_count(int64_t columns) { return units(padded_columns(columns), kPanel); }
template <typename X>
inline int64_t depth_words(int64_t depth) {
  return units(depth, kDepths<X>);
}
// Returns the words of the parameters and the panels.
template <typename X>
inline int64_t layer_words(int64_t depth, int64_t columns) {
  return padded_columns(columns) * (kParameters<X> + depth_words<X>(depth));
}

}  // namespace

// The step that follows the product.
enum class After {
  nothing,
  gelu,
  relu,
  add,  // added to the values in `out`
};

// out = x * weight^T + bias
//
// Tokens lie in lines of `run` tokens, which begin `pitch` numbers apart. Floats may also lie in
// `segments` pieces of the depth, which are `pitch` apart too: the neighbours of a pixel do. A
// matrix of tokens is one line and one segment. A transposed matrix has a stride of 1, and a `step`
// of more.
template <typename X>
struct LinearArgs {
  const X* x = nullptr;          // the first token; kSpare bytes of any value follow the last one
  const void* packed = nullptr;  // the layer
  int64_t rows = 0, depth = 0, columns = 0;
  int64_t stride = depth, step = 1;  // from token to token, and from depth to depth of a float
  int64_t run = rows, pitch = 0, segments = 1;
  float scale = 1;  // the size of a step of x, if it has 8 bits
  After after = After::nothing;
  float* out = nullptr;          // (rows, columns)
  int64_t out_stride = columns;  // from row to row of `out`
  uint8_t* quantized = nullptr;  // the result as 8 bits, instead of `out`; not for After::add
  Quantizer quantizer = {};      // of `quantized`
};

template <typename X>
struct LinearKernels {
  // Computes the columns of panels [first, last) of rows [begin, end).
  using Rows = void(const LinearArgs<X>&, int64_t begin, int64_t end, int64_t first, int64_t last);
  Rows* rows;
  // The same with the CPU's products of four bytes, or with AMX; null on tiers without any.
  Rows *by_fours = nullptr, *by_tiles = nullptr;
  // Writes panels [first, last) of a weight (columns, depth) behind the parameters at `packed`.
  // This and the next are null for bytes.
  void (*pack)(const float* weight, int64_t columns, int64_t depth, int64_t first, int64_t last,
               float* packed) = nullptr;
  // Writes a panel of a transposed weight, whose rows (depth, columns) are `pitch` apart.
  void (*pack_rows)(const float* rows, int64_t pitch, int64_t depth, int64_t columns,
                    float* panel) = nullptr;
};

}  // namespace darswin

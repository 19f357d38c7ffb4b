// Deformable attention, as in darswin/models/dat.py. Points are pixels of the map (y, x).
#include <cmath>
#include <vector>

#include "layers.h"
#include "parallel.h"
#include "sampling.h"

namespace darswin {
namespace {

// Where a point lies that is moved from the centre of token k along an axis. As in the released
// code, the centres of the outermost pixels are at the edges of the map.
float moved(int64_t k, float offset, int64_t size) {
  const auto length = static_cast<float>(size);
  return (static_cast<float>(k) + 0.5f + offset) * ((length - 1) / length);
}

// The number before a place among `size` numbers, from -1 to `size`, and the part of the next.
struct Place {
  int64_t first;
  float part;
};
Place place(float at, int64_t size) {
  const float bounded = at > -1 ? std::min(at, static_cast<float>(size)) : -1.0f;  // NaN: -1
  return {static_cast<int64_t>(std::floor(bounded)), bounded - std::floor(bounded)};
}

// Writes one token of a depthwise convolution of a map (height, width, dim), 0 around it.
void convolve(const Deformable& by, const float* map, int64_t height, int64_t width, int64_t dim,
              int64_t y, int64_t x, float* out) {
  const auto& kernel = kernels<ElementKernels>();
  const int64_t side = by.kernel, half = side / 2;
  std::copy_n(by.around + side * side * dim, dim, out);
  for (int64_t i = std::max(y - half, int64_t{0}); i <= std::min(y + half, height - 1); ++i) {
    for (int64_t j = std::max(x - half, int64_t{0}); j <= std::min(x + half, width - 1); ++j) {
      const float* weight = by.around + ((i - y + half) * side + j - x + half) * dim;
      kernel.add_products(map + (i * width + j) * dim, weight, out, dim);
    }
  }
}

// Writes the biases of the key at a point and all queries (height, width): those of the table of
// offsets (2 height - 1, 2 width - 1) between its entries, 0 outside. `row` and `places` are
// working memory for 2 width + 2 and `width` elements.
void write_biases(const float* table, int64_t height, int64_t width, const float* point,
                  std::vector<float>& row, std::vector<Place>& places, float* to) {
  const int64_t rows = 2 * height - 1, columns = 2 * width - 1;
  for (int64_t x = 0; x < width; ++x) {
    places[x] = place(moved(x, 0, width) - point[1] + static_cast<float>(width - 1), columns);
  }
  for (int64_t y = 0; y < height; ++y, to += width) {
    const Place at = place(moved(y, 0, height) - point[0] + static_cast<float>(height - 1), rows);
    const auto inside = [&](int64_t k) { return k >= 0 && k < rows; };
    const float upper_part = inside(at.first) ? 1 - at.part : 0;
    const float lower_part = inside(at.first + 1) ? at.part : 0;
    const float* upper = table + (inside(at.first) ? at.first * columns : 0);
    const float* lower = table + (inside(at.first + 1) ? (at.first + 1) * columns : 0);
    for (int64_t k = 0; k < columns; ++k) {  // between zeros
      row[k + 1] = upper_part * upper[k] + lower_part * lower[k];
    }
    for (int64_t x = 0; x < width; ++x) {
      const float* pair = &row[places[x].first + 1];
      to[x] = (1 - places[x].part) * pair[0] + places[x].part * pair[1];
    }
  }
}

}  // namespace

const float* Block::deform(const float* x, int64_t batch, const float* table, int64_t table_rows,
                           float* qkv) const {
  const int64_t height = windows.rings, width = windows.sectors, tokens = height * width;
  const int64_t rows = batch * tokens, dim = norm1.dim, heads = windows.heads;
  const int64_t groups = deformable.groups, channels = dim / groups;
  const auto& kernel = kernels<ElementKernels>();
  const auto for_rows = [&](int64_t numbers, auto body) {
    constexpr double kPerMicrosecond = 2000;
    const double work = static_cast<double>(rows) * numbers;
    parallel_ranges(rows, threads_for(work / kPerMicrosecond), body);
  };
  float *q = qkv + rows * 3 * dim, *around = q + rows * dim, *kv = around + rows * dim;
  float *points = kv + rows * 2 * dim, *biases = points + rows * 2 * groups;

  multiply(x, rows, this->qkv, q);
  for_rows(deformable.kernel * deformable.kernel * dim / 4, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t token = row % tokens;
      convolve(deformable, q + (row - token) * dim, height, width, dim, token / width,
               token % width, around + row * dim);
    }
  });
  normalize(around, rows * groups, deformable.norm, around);
  for_rows(dim, [&](int64_t begin, int64_t end) {
    kernel.gelu(around + begin * dim, (end - begin) * dim);
  });
  multiply(around, rows * groups, deformable.offset, points);

  float* sampled = around;
  for_rows(4 * dim, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t token = row % tokens;
      for (int64_t group = 0; group < groups; ++group) {
        float* point = points + (row * groups + group) * 2;
        point[0] = moved(token / width, deformable.reach / 2 * std::tanh(point[0]), height);
        point[1] = moved(token % width, deformable.reach / 2 * std::tanh(point[1]), width);
        const int64_t first = group * channels;
        sample_at(x + (row - token) * dim + first, height, width, dim, point[1], point[0],
                  sampled + row * dim + first, channels);
      }
    }
  });
  multiply(sampled, rows, deformable.kv, kv);

  const int64_t entries = (2 * height - 1) * (2 * width - 1);
  for_rows(3 * dim + heads * tokens * 4, [&](int64_t begin, int64_t end) {
    std::vector<float> line(2 * width + 2);
    std::vector<Place> places(width);
    for (int64_t row = begin; row < end; ++row) {
      std::copy_n(q + row * dim, dim, qkv + row * 3 * dim);
      std::copy_n(kv + row * 2 * dim, 2 * dim, qkv + (row * 3 + 1) * dim);
      const int64_t image = row / tokens;
      for (int64_t head = 0; head < heads; ++head) {
        const int64_t group = head / (heads / groups);
        write_biases(table + ((table_rows == 1 ? 0 : image) * heads + head) * entries, height,
                     width, points + (row * groups + group) * 2, line, places,
                     biases + ((image * heads + head) * tokens + row % tokens) * tokens);
      }
    }
  });
  return biases;
}

}  // namespace darswin

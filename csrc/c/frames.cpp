// libdarswin_frames.so: the C functions of darswin_frames.h.
#include <darswin_frames.h>

#include <exception>
#include <stdexcept>
#include <string>
#include <system_error>
#include <type_traits>
#include <vector>

#include "../core/network_file.h"
#include "../core/parallel.h"

#define DARSWIN_API extern "C" __attribute__((visibility("default")))

struct darswin_network : darswin::FrameNetwork {
  using FrameNetwork::FrameNetwork;
};

namespace {

thread_local std::string last_error;

// The result of `body`; if it throws, NULL for a pointer, else -1.
template <typename Body>
auto caught(Body body) noexcept {
  try {
    return body();
  } catch (const std::exception& error) {
    try {
      last_error = error.what();
    } catch (...) {
      last_error.clear();
    }
  } catch (...) {
    last_error.clear();
  }
  using Result = decltype(body());
  if constexpr (std::is_pointer_v<Result>) {
    return Result{nullptr};
  } else {
    return Result{-1};
  }
}

void require(bool condition, const char* what) {
  if (!condition) throw std::invalid_argument(what);
}

const darswin_network& given(const darswin_network* network) {
  require(network != nullptr, "network must not be NULL");
  return *network;
}

const std::vector<int64_t>& shape_of(const darswin_network* network, int64_t k) {
  require(k >= 0 && k < given(network).output_count(), "there is no such output");
  return network->output_shape(k);
}

}  // namespace

DARSWIN_API const char* darswin_version() { return DARSWIN_VERSION; }

DARSWIN_API const char* darswin_file_version() {
  static const std::string text =
      std::to_string(darswin::kFileVersion[0]) + "." + std::to_string(darswin::kFileVersion[1]);
  return text.c_str();
}

DARSWIN_API const char* darswin_last_error() { return last_error.c_str(); }

DARSWIN_API darswin_network* darswin_load(const char* path) {
  return caught([&] {
    require(path != nullptr, "path must not be NULL");
    try {
      return new darswin_network(path);
    } catch (const std::system_error& error) {
      throw std::runtime_error(std::string(path) + ": " + error.code().message());
    }
  });
}

DARSWIN_API void darswin_free(darswin_network* network) { delete network; }

DARSWIN_API int darswin_frame_size(const darswin_network* network, int64_t size[3]) {
  return caught([&] {
    require(size != nullptr, "size must not be NULL");
    size[0] = given(network).height();
    size[1] = network->width(), size[2] = network->channels();
    return 0;
  });
}

DARSWIN_API int64_t darswin_output_count(const darswin_network* network) {
  return caught([&] { return given(network).output_count(); });
}

DARSWIN_API const int64_t* darswin_output_shape(const darswin_network* network, int64_t output) {
  return caught([&] { return shape_of(network, output).data(); });
}

DARSWIN_API int64_t darswin_output_axes(const darswin_network* network, int64_t output) {
  return caught([&] { return static_cast<int64_t>(shape_of(network, output).size()); });
}

DARSWIN_API int64_t darswin_output_numbers(const darswin_network* network, int64_t output) {
  return caught([&] {
    int64_t numbers = 1;
    for (const int64_t size : shape_of(network, output)) numbers *= size;
    return numbers;
  });
}

DARSWIN_API int64_t darswin_label_count(const darswin_network* network) {
  return caught([&] { return static_cast<int64_t>(given(network).labels().size()); });
}

DARSWIN_API const char* darswin_label(const darswin_network* network, int64_t label) {
  return caught([&] {
    const auto& labels = given(network).labels();
    require(label >= 0 && label < static_cast<int64_t>(labels.size()), "there is no such label");
    return labels[label].c_str();
  });
}

DARSWIN_API int darswin_run(const darswin_network* network, const darswin_frame* frame,
                            float* const* outputs, int64_t threads) {
  return caught([&] {
    require(frame != nullptr && frame->pixels != nullptr && outputs != nullptr,
            "frame, its pixels and outputs must not be NULL");
    require(threads >= 1, "threads must be at least 1");
    for (int64_t k = 0; k < given(network).output_count(); ++k) {
      require(outputs[k] != nullptr, "outputs must not be NULL");
    }
    const darswin::Frame pixels{frame->pixels,        frame->height,     frame->width,
                                frame->channels,      frame->row_stride, frame->column_stride,
                                frame->channel_stride};
    network->check(pixels);
    const darswin::ThreadLimit limit(threads);
    network->run(pixels, outputs);
    return 0;
  });
}

// Prints the class of a picture, without torch and without Python: frame NETWORK PICTURE.ppm
//
// darswin.deploy.camera.export_network wrote the network of a classifier. The picture is a binary
// PPM (RGB) or PGM (gray) file with 8 bits and without comments.

#include <darswin_frames.h>

#include <algorithm>
#include <fstream>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

void require(bool condition, const std::string& why) {
  if (!condition) throw std::runtime_error(why);
}

int main(int count, char** arguments) try {
  require(count == 3, "usage: frame NETWORK PICTURE.ppm");
  const std::unique_ptr<darswin_network, void (*)(darswin_network*)> network(
      darswin_load(arguments[1]), darswin_free);
  require(network != nullptr, darswin_last_error());
  require(darswin_output_axes(network.get(), 0) == 1, "the network is no classifier");

  const std::string path = arguments[2];
  std::ifstream file(path, std::ios::binary);
  require(file.is_open(), path + " cannot be opened");
  std::string kind;
  uint16_t width = 0, height = 0, largest = 0;
  file >> kind >> width >> height >> largest;
  file.get();  // the one space before the pixels
  require(file && (kind == "P5" || kind == "P6") && largest == 255,
          path + " is not a binary PPM or PGM file with 8 bits and without comments");
  const int channels = kind == "P6" ? 3 : 1;
  std::vector<uint8_t> pixels(size_t{width} * height * channels);
  file.read(reinterpret_cast<char*>(pixels.data()), static_cast<std::streamsize>(pixels.size()));
  require(!!file, path + " ends too early");

  const darswin_frame frame{pixels.data(), height, width, channels, width * channels, channels, 1};
  std::vector<float> probabilities(darswin_output_numbers(network.get(), 0));
  float* const outputs[] = {probabilities.data()};
  const int failed = darswin_run(network.get(), &frame, outputs, 1);
  require(!failed, darswin_last_error());
  const auto best = std::max_element(probabilities.begin(), probabilities.end());
  const int64_t number = best - probabilities.begin();
  const char* label = darswin_label(network.get(), number);
  std::cout << "class " << (label != nullptr ? label : std::to_string(number)) << ", probability "
            << *best << '\n';
} catch (const std::exception& error) {
  std::cerr << "frame: " << error.what() << '\n';
  return 1;
}

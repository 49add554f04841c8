while true do
    h3c.dOut(17, 1) -- coloca a saída 17 em nível alto
    h3c.dOut(17, 0) -- coloca a saída 17 em nível baixo
end
